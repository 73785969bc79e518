// Comparison of runs: their settings, times with intervals, curves, and the distance of their final positions.
"use strict";
(() => {
  const { element, data, number, fixed, percent, state, glyph, title, address, rowOf, picture, floats, whole } = springbench;
  const FIELDS = [
    ["scene", "scene"], ["size", "size"], ["solver", "solver"], ["parameters", "parameters"], ["integrator", "integrator"], ["time_step", "time step, s"], ["initial_guess", "first guess"],
    ["max_iterations", "iterations at most"], ["residual_rtol", "tolerance"], ["threads", "threads"], ["frames", "frames"], ["rounds", "rounds"], ["cpu", "processor"], ["commit", "commit"], ["source_fingerprint", "sources"],
  ];
  const CURVES = [["step_ms", "ms a step", { type: "log" }], ["residual", "residual, J^½", { type: "log" }], ["num_iterations", "iterations", {}], ["max_strain", "largest strain, %", {}], ["objective", "objective, J", {}], ["reference_distance", "from the reference, sizes", { type: "log" }]];

  const middle = some => { const s = Float64Array.from(some).sort(), h = s.length >> 1; return s.length % 2 ? s[h] : (s[h - 1] + s[h]) / 2; };

  // The 95 % interval of the ratio of two runs' ms a step, by resampling the frames (seeded, so it is reproducible).
  function interval(frames, first) {
    const pairs = frames.step_ms.map((v, k) => [v, first.step_ms[k]]).filter(([a, b]) => a > 0 && b > 0);
    if (pairs.length < 2) return null;
    let seed = 12345;
    const random = () => { seed = (1103515245 * seed + 12345) % 2147483648; return seed / 2147483648; };
    const quotient = some => middle(some.map(([v]) => v)) / middle(some.map(([, v]) => v));
    const found = Float64Array.from({ length: 1000 }, () => quotient(pairs.map(() => pairs[Math.floor(random() * pairs.length)]))).sort();
    return [found[25], found[974]];
  }

  function table(rows, series) {
    const differing = FIELDS.filter(([key]) => rows.length > 1 && new Set(rows.map(row => row[key])).size > 1);
    const same = FIELDS.filter(field => !differing.includes(field)).map(([key, words]) => [words, rows[0][key]]).filter(([key, v]) => v !== null && v !== undefined && v !== "{}").map(([words, v]) => [words, words === "commit" ? springbench.commit(v) : v]);
    const line = (words, cells) => element("tr", {}, element("th", { scope: "row" }, words), ...cells.map(cell => element("td", {}, cell ?? "–")));
    const against = rows.map((row, k) => {
      if (!k) return "1";
      if (!row.step || !rows[0].step) return "–";
      const found = series[k] && series[0] ? interval(series[k], series[0]) : null;
      return `${number(row.step / rows[0].step)}${found ? ` (${number(found[0])} to ${number(found[1])})` : ""}`;
    });
    const body = [
      ...differing.map(([key, words]) => line(words, rows.map(row => (key === "commit" ? springbench.commit(row[key]) : key === "parameters" ? Object.entries(JSON.parse(row[key])).map(pair => pair.join(" ")).join(", ") || "–" : String(row[key] ?? "–"))))),
      line("status", rows.map(row => state(row.status))), line("ms a step, quartiles", rows.map(row => (row.step === null ? "–" : `${number(row.step)} (${number(row.lower)} to ${number(row.upper)})`))),
      rows.length > 1 && line("times as long as the first, 95 % by frames", against), line("least ms", rows.map(row => number(row.least))), line("prepare ms, cold, warm", rows.map(row => `${number(row.cold)}, ${number(row.warm)}`)),
      line("iterations, stopped by", rows.map(row => `${number(row.num_iterations)}, ${row.termination_reason || "–"}`)), line("last residual", rows.map(row => fixed(row.residual))), line("largest strain", rows.map(row => percent(row.max_strain))),
      rows.length > 1 && line("last positions", rows.map((row, k) => (k ? (row.positions_digest && row.positions_digest === rows[0].positions_digest ? "identical" : "differ") : ""))),
    ];
    const head = rows.map(row => element("th", { scope: "col" }, glyph(row.mark), " ", element("a", { href: address("runs", { sweep: row.slug, run: row.key }) }, title(row))));
    return [element("div.scroll", { tabIndex: 0, role: "region", "aria-label": "The runs side by side" }, element("table.plain", {}, element("thead", {}, element("tr", {}, element("td"), ...head)), element("tbody", {}, ...body.filter(Boolean)))),
      element("p.muted", {}, `The same in all: ${same.map(([words, v]) => `${words} ${typeof v === "number" ? number(v) : v}`).join(", ")}.`)];
  }

  async function curves(box, rows, series) {
    const labels = rows.map((row, k) => `${k + 1} ${title(row)}`), twice = row => rows.filter(other => other.mark.color === row.mark.color).length > 1;
    const DASHES = ["solid", "dash", "dot", "dashdot"];
    const marks = Object.fromEntries(rows.map((row, k) => [labels[k], twice(row) ? { ...row.mark, dash: DASHES[k % 4] } : row.mark]));
    const drawings = [];
    for (const [column, words, how] of CURVES) {
      const items = rows.map((row, k) => series[k] && {
        label: labels[k], description: "", frame: series[k].frame, [column]: column === "max_strain" ? series[k].max_strain.map(v => v && 100 * v) : series[k][column],
        ...(column === "step_ms" ? { step_ms_low: series[k].lower, step_ms_high: series[k].upper } : {}),
      }).filter(item => item && item[column].some(v => v !== null));
      if (!items.length) continue;
      const plot = element("div.plot.small", { tabIndex: 0, role: "group", "aria-label": `Plot: ${words} by frame. Arrow keys go through its points.` });
      box.append(plot);
      const chart = { styles: marks, hover: [["frame", "frame"], [column, words]] };
      drawings.push(() => springbench.chart.draw(plot, chart, items, { column: "frame", title: "frame", axis: {} }, { column, title: words, axis: how }, { small: true, zoomKey: `zoom-${column}` }));
    }
    for (const draw of drawings) await draw();  // all of them have their places now
  }

  async function differences(box, rows) {
    const tables = new Map();
    for (const row of rows) {
      if (row.mesh) tables.set(row, await data(`${row.slug}/meshes/${row.unit}`));
    }
    const [first, ...others] = rows, base = tables.get(first);
    if (!base || !others.some(row => tables.has(row))) {
      box.append(element("p.muted", {}, "Where they differ is drawn from their recordings: ", element("code", {}, "springbench report"), " takes the last frames in."));
      return;
    }
    const p = floats(base.positions), view = springbench.camera(p), shape = { springs: whole(base.springs), triangles: whole(base.triangles) };
    for (const row of others) {
      const found = tables.get(row);
      if (!found || found.positions.length !== base.positions.length) {
        box.append(element("p.muted", {}, `${title(row)}: another mesh than the first run's, or no recording.`));
        continue;
      }
      const q = floats(found.positions), far = new Float32Array(q.length / 3);
      for (let i = 0; i < far.length; i++) far[i] = Math.hypot(q[3 * i] - p[3 * i], q[3 * i + 1] - p[3 * i + 1], q[3 * i + 2] - p[3 * i + 2]);
      const most = far.reduce((a, b) => Math.max(a, b), 0), drawn = springbench.mesh(view, shape, `Last frame of ${title(row)}, coloured by its distance from the first run`);
      const ratio = base.mean_rest_length ? most / base.mean_rest_length : 0;
      const doubt = most < 1e-6 * view.radius ? "; recordings have single precision, which resolves no less" : "";
      const caption = `${title(row)}: at most ${number(most)} m from ${title(first)}, ${number(ratio)} mean rest lengths${doubt}`;
      box.append(element("figure", {}, drawn.canvas, element("figcaption", {}, caption),
        springbench.scaleBox("0", `${number(most || 0)} m`)));
      drawn.show(q, far.map(v => (most ? v / most : 0)));
    }
  }

  springbench.views.compare = async (content, query) => {
    const box = element("div.page.compare");
    content.append(box);
    async function update(next) {
      const keys = (next.get("sel") || "").split(",").filter(Boolean).slice(0, 8), rows = (await Promise.all(keys.map(rowOf))).filter(Boolean);
      box.replaceChildren(element("h1", {}, rows.length > 1 ? "Comparison" : "Frame by frame"), element("p", {}, element("a", { href: address("runs", { sel: keys.join(",") }) }, "Choose other runs")));
      if (!rows.length) return void box.append(element("p", {}, "No run is chosen: tick two or more in the table of runs."));
      const series = await Promise.all(rows.map(row => (row.step === null ? null : data(`${row.slug}/runs/${row.run_id}`))));
      const plots = element("div.curves"), meshes = element("div.differ"), shots = rows.filter(row => picture(row));
      box.append(...table(rows, series), element("h3", {}, "Frame by frame"), element("ul.legend", { style: "display:flex;flex-wrap:wrap;gap:4px 20px" }, ...rows.map((row, k) => element("li", {}, glyph(row.mark), ` ${k + 1} ${title(row)}`))), plots);
      if (rows.length > 1) box.append(element("h3", {}, "Difference of the last positions"), meshes);
      if (shots.length) box.append(element("div.pictures", {}, ...shots.map(row => element("figure", {}, element("a", { href: picture(row) }, element("img", { src: picture(row), alt: `Picture of ${title(row)}` })), element("figcaption", {}, title(row))))));
      await curves(plots, rows, series);
      if (rows.length > 1) await differences(meshes, rows);
    }
    const recolour = () => update(springbench.where().query);
    addEventListener("recolour", recolour);
    await update(query);
    return { update, leave: () => removeEventListener("recolour", recolour) };
  };
})();
