// The runs of all sweeps as rows, and further data of each sweep.
"use strict";
Object.assign(springbench, (() => {
  const { data, link, own } = springbench;
  let index = null;
  const tables = new Map();

  // Build the rows of a sweep's runs from its columns.
  async function rowsOf(sweep) {
    if (tables.has(sweep.slug)) return tables.get(sweep.slug);
    const table = await data(`${sweep.slug}/runs`), names = Object.keys(table.columns);
    const read = names.map(name => {
      const column = table.columns[name];
      return Array.isArray(column) ? k => column[k] : k => (column.indices[k] < 0 ? null : column.values[column.indices[k]]);
    });
    const rows = Array.from({ length: table.num_rows }, (_, k) => {
      const row = { sweep: sweep.name, slug: sweep.slug };
      for (let c = 0; c < names.length; c++) row[names[c]] = read[c](k);
      row.key = `${sweep.slug}/${row.run_id}`;
      row.mark = own(table.styles, row.label);
      row.citation = own(table.citations, row.solver)?.citation;
      return row;
    });
    tables.set(sweep.slug, rows);
    return rows;
  }

  // Return all rows, or those of one sweep.
  async function rows(slug = "") {
    index ??= await data("index");
    const chosen = index.sweeps.filter(sweep => sweep.runs && (!slug || sweep.slug === slug));
    return (await Promise.all(chosen.map(rowsOf))).flat();
  }

  async function rowOf(key) {
    const slug = key.slice(0, key.lastIndexOf("/"));
    return (await rows(slug)).find(row => row.key === key);
  }

  const sweepOf = slug => index.sweeps.find(sweep => sweep.slug === slug);
  const references = async slug => (await data(`${slug}/runs`)).citations;
  const picture = row => (row.picture ? link(sweepOf(row.slug).relative_url, `pictures/${row.unit}.png`) : "");
  const recording = row => (row.recording ? link(sweepOf(row.slug).relative_url, `recordings/${row.unit}.rrd`) : "");
  const title = row => `${row.scene}${row.size ? ` ${row.size}` : ""}, ${row.label}`;

  // Quote a word for the shell.
  const quoted = words => (/^[\w./:=@%+,-]+$/.test(words) ? words : `'${String(words).replaceAll("'", "'\\''")}'`);

  // Return the command that repeats a run: of its scene only if the solver's name identifies it, otherwise of the sweep.
  function command(row) {
    const sweep = sweepOf(row.slug), scene = own(sweep.scenes, row.scene);
    const whole = `springbench run ${quoted(sweep.config || `${sweep.name}.yaml`)}`;
    if (!scene || !row.has_default_parameters || row.plugins) return `${whole} --rerun`;
    const chosen = row.error_requested !== null && row.error_requested !== undefined;
    const stated = {
      "max-iterations": row.max_iterations, rtol: row.residual_rtol === 0 ? "auto" : row.residual_rtol, integrator: row.integrator, "initial-guess": row.initial_guess,
    };
    const options = {
      size: row.size || null, solver: row.solver, ...(chosen ? { "error-target": row.error_requested } : stated), "time-step": row.time_step && (Math.abs(Math.round(1 / row.time_step) * row.time_step - 1) < 1e-12 ? `1/${Math.round(1 / row.time_step)}` : row.time_step), threads: row.threads,
      frames: row.frames, rounds: row.rounds,
    };
    const given = Object.entries(options).filter(([, value]) => value !== null && value !== undefined);
    return [`springbench run ${quoted(scene)}`, ...given.map(([name, value]) => `--${name} ${quoted(String(value))}`)].join(" ");
  }

  // Return the path of a results file as commands refer to it.
  const called = file => quoted(`${index.results_path === "." ? "" : `${index.results_path}/`}${plain(file).replace(/^\.\//, "")}`);
  function plain(file) {
    try {
      return decodeURIComponent(file);
    } catch {  // a name that is no UTF-8
      return file;
    }
  }

  return { called, quoted, rows, rowOf, sweepOf, references, picture, recording, title, command };
})());
