// One run: identification, outcome, picture and recording, and the command that repeats it.
"use strict";
Object.assign(springbench, (() => {
  const { element, put, number, percent, fixed, step, day, commit, glyph, state, copy, link, own, title, picture, recording, command, rowOf, references, sweepOf } = springbench;

  const pair = ([name, value]) => [element("dt", {}, name), element("dd", {}, value ?? "–")];
  const list = pairs => element("dl", {}, ...pairs.filter(([, value]) => value !== null && value !== undefined && value !== "").flatMap(pair));

  function code(words, label) {
    return element("div.command", {}, element("code", { tabIndex: 0, "aria-label": label }, words), element("button.quiet", { type: "button", onclick: () => copy(words) }, "Copy"));
  }

  // The reference of a method: authors, year and DOI, and BibTeX to copy.
  function method(reference) {
    if (!reference) return null;
    const doi = /doi:(\S+)$/.exec(reference.citation);
    const words = doi ? reference.citation.slice(0, doi.index).replace(/, $/, "") : reference.citation;
    return element("p.method", {}, words, doi && ", ", doi && element("a", { href: `https://doi.org/${doi[1]}`, rel: "noreferrer" }, `doi:${doi[1]}`), " ",
      reference.bibtex && element("button.quiet", { type: "button", onclick: () => copy(reference.bibtex) }, "Copy BibTeX"));
  }

  // A recording: replayed in the page if it is among the page's scripts, otherwise offered as a file.
  function replay(id, file, name, words) {
    if (!file) return element("p.muted", {}, "No recording was made.");
    const box = element("div.replays");
    if (name) {
      box.append(element("button.strong", { type: "button", onclick: () => springbench.replay(id, name, { title: words, file }) }, "Replay"),
        element("a", { href: file }, "Recording (.rrd)"));
    } else {
      box.append(element("p.muted", {}, element("a", { href: file }, "The recording (.rrd)"), " opens by this; ", element("code", {}, "springbench report"), " puts it into this page."),
        code(`springbench view ${springbench.called(file)}`, "Command that opens the recording"));
    }
    return box;
  }

  function settings(row) {
    const given = Object.entries(JSON.parse(row.parameters || "{}"));
    return list([
      ["mesh", `${number(row.vertices, 6)} vertices, ${number(row.springs, 6)} springs`], ["integrator", row.integrator], ["time step", row.time_step && step(row.time_step)],
      ["first guess", row.initial_guess], ["iterations at most", row.max_iterations], ["tolerance", row.residual_rtol === 0 ? "auto" : row.residual_rtol], ["error requested", row.error_requested], ["estimated", row.error_estimated],
      ["threads", row.threads], ["frames, rounds", row.frames && `${row.frames}, ${row.rounds}`], ...given.map(([name, value]) => [name, String(value)]),
    ]);
  }

  function losses(row) {
    if (row.integrator_share === undefined || row.integrator_share === null) return null;
    const parts = [["damping", row.damping_share], ["friction", row.friction_share], ["the integrator", row.integrator_share], ["unconverged solves", row.solve_share]];
    return parts.map(([cause, share]) => `${percent(share || 0)} by ${cause}`).join(", ") + `, of ${number(row.provided_energy)} J`;
  }

  function figures(row) {
    if (row.step === null) return null;
    return list([
      ["ms a step", `${number(row.step)}   (quartiles ${number(row.lower)} to ${number(row.upper)}, least ${number(row.least)})`],
      ["prepare, ms", `cold ${number(row.cold)}, warm ${number(row.warm)}`], ["local, global, ms", row.local !== null ? `${number(row.local)}, ${number(row.global)}` : null],
      ["iterations", `${number(row.num_iterations)}, stopped by ${row.termination_reason || "their number"}`],
      ["last residual", row.residual === null ? "none: it minimises nothing" : `${fixed(row.residual)} J^½`],
      ["largest strain", percent(row.max_strain)], ["99 % of springs below", row.strain_p99 === undefined || row.strain_p99 === null ? null : percent(row.strain_p99)],
      ["energy dissipated", losses(row)],
      ["deepest inside an obstacle", row.penetration_depth ? `${number(row.penetration_depth)} m` : null],
    ]);
  }

  async function detail(panel, key, { close }) {
    const row = await rowOf(key);
    const shut = element("button.quiet.close", { type: "button", onclick: close, "aria-label": "Close" }, "×");
    panel.onkeydown = event => { if (event.key === "Escape") close(); };
    if (!row) {
      panel.append(shut, element("p", {}, `There is no run ${key} any more.`));
      return;
    }
    const source = own(await references(row.slug), row.solver), src = picture(row), sweep = sweepOf(row.slug);
    put(panel, shut, element("h2", {}, glyph(row.mark), ` ${row.scene}${row.size ? ` ${row.size}` : ""}`), element("p.label", {}, row.label),
      element("p.states", {}, state(row.status), row.outcome && state(row.outcome), row.staleness && element("span.code", {}, row.staleness)),
      row.reason && element("p.reason", {}, row.reason),
      src && element("a.shot", { href: src }, element("img", { src, alt: `The run's last frame and earlier ones: ${title(row)}` })),
      replay(row.run_id, recording(row), row.replay && `site/data/${encodeURIComponent(row.slug)}/recordings/${encodeURIComponent(row.unit)}.js`, title(row)),
      element("h3", {}, "Measured"), figures(row) || element("p.muted", {}, "Nothing: see its status."),
      element("h3", {}, "Settings"), settings(row),
      element("h3", {}, "Repeat"), code(command(row), "Command that repeats the run"),
      source && element("h3", {}, "Method"), method(source),
      element("h3", {}, "Made by"), list([
        ["code", element("span", {}, element("code", {}, commit(row.commit)), ` (sources ${row.source_fingerprint})`)], ["machine", `${row.cpu || "unknown"} (${(row.machine_id || "").slice(0, 6)})`],
        ["on", (row.started_at || "").replace("T", " ").slice(0, 16)], ["timed", row.timing], ["own code", row.plugins],
      ]),
      element("p", {}, element("a", { href: link(sweep.relative_url, `rows/${row.unit}.parquet`) }, "Its rows (Parquet)"), " · ",
        element("a", { href: springbench.address("compare", { sel: key }) }, "Frame by frame")));
  }

  return { detail, method, replayBox: replay, commandBox: code, definitions: list };
})());
