// Table of all runs: sorting, filtering, selection for comparison; the state of the view is in the URL.
"use strict";
(() => {
  const { element, change, address, madeBy, number, count, percent, fixed, glyph, state, many, save, picture } = springbench;
  const words = (row, key) => row[key] ?? "";
  const shot = row => {
    const src = picture(row);
    return src ? element("img", { src, alt: "", loading: "lazy", decoding: "async", width: 64, height: 36 }) : element("span.noshot");
  };
  const marked = row => (row.staleness ? element("span.code", { title: row.staleness === "stale" ? "made by other code than the newest run of its scene and solver" : "made by an earlier commit than the newest run" }, row.staleness) : "");
  const DOUBT = "the process was interrupted while steps were timed: its least time is nearest to the truth";
  const doubt = row => (row.preempted ? element("span.doubt", { title: DOUBT }, " !") : "");

  // meaning: tooltip; show: cell of a row; numeric: right-aligned; spare: priority for removal if space is short.
  const COLUMNS = [
    { id: "check", width: "34px", title: "Compare", sort: false, show: (row, on) => element("span.box", { "aria-label": on ? "chosen to compare" : "not chosen" , role: "img"}, on ? "✓" : "") },
    { id: "shot", width: "76px", spare: 4, title: "Picture", sort: false, show: shot },
    { id: "sweep", width: "minmax(96px, 1fr)", spare: 5, title: "Results", show: row => row.sweep },
    { id: "scene", width: "minmax(120px, 2fr)", title: "Scene", show: row => row.scene },
    { id: "size", width: "58px", title: "Size", numeric: true, show: row => row.size || "–" },
    { id: "solver", width: "minmax(150px, 2fr)", title: "Solver", meaning: "and the options in which its runs differ", show: row => element("span.solver", { title: row.citation }, glyph(row.mark), row.solver, row.options && element("span.options", {}, row.options)) },
    { id: "status", width: "minmax(118px, 1fr)", title: "Status", show: row => element("span", {}, state(row.status), row.staleness && " ", marked(row)) },
    { id: "outcome", width: "minmax(116px, 1fr)", title: "Judged", show: row => (row.outcome ? state(row.outcome) : "–") },
    { id: "termination_reason", width: "92px", spare: 3, title: "Stopped by", meaning: "what ended the last step's iterations", show: row => words(row, "termination_reason") || "–" },
    { id: "num_iterations", width: "64px", spare: 6, title: "Iter.", meaning: "median iterations a step", numeric: true, show: row => number(row.num_iterations) },
    { id: "residual", width: "84px", title: "Residual", meaning: "of the last step, J^(1/2)", numeric: true, show: row => fixed(row.residual) },
    { id: "step", width: "86px", title: "ms a step", meaning: "the median over frames and rounds", numeric: true, show: row => element("span", {}, number(row.step), doubt(row)) },
    { id: "least", width: "82px", spare: 7, title: "Least ms", numeric: true, show: row => number(row.least) },
    { id: "warm", width: "92px", spare: 8, title: "Prepare ms", meaning: "warm", numeric: true, show: row => number(row.warm) },
    { id: "max_strain", width: "78px", spare: 1, title: "Strain", meaning: "the largest of all springs and frames", numeric: true, show: row => percent(row.max_strain) },
    { id: "strain_p99", width: "78px", spare: 2, title: "99 %", meaning: "strain that 99 % of the springs stay below", numeric: true, show: row => percent(row.strain_p99) },
    { id: "integrator_share", width: "84px", spare: 9, title: "Integrator", meaning: "energy that the time integrator dissipated, of that provided; damping, friction and unconverged solves are in the details", numeric: true, show: row => percent(row.integrator_share) },
  ];
  const FACETS = [["sweep", "Results"], ["scene", "Scene"], ["size", "Size"], ["solver", "Solver"], ["status", "Status"], ["outcome", "Judged"], ["termination_reason", "Stopped by"], ["staleness", "Code"]];
  const LIMITS = [["residual", "Residual at most"], ["step", "ms a step at most"], ["max_strain", "Strain at most (%)"]];

  const value = (row, key) => (key === "sweep" ? row.slug : String(row[key] ?? ""));

  function fits(row, query, except = "") {
    for (const [key] of FACETS) if (key !== except && query.get(key) && value(row, key) !== query.get(key)) return false;
    for (const [key] of LIMITS) {
      const most = query.get(`max-${key}`);
      if (most && !(row[key] !== null && row[key] <= Number(most) / (key === "max_strain" ? 100 : 1))) return false;
    }
    const words = (query.get("q") || "").toLowerCase();
    if (!words) return true;
    const all = `${row.scene} ${row.size} ${row.label} ${row.integrator} ${row.reason || ""} ${row.run_id} ${row.parameters}`.toLowerCase();
    return words.split(/\s+/).every(word => all.includes(word));
  }

  function sorted(rows, by) {
    const down = by.startsWith("-"), key = down ? by.slice(1) : by, sign = down ? -1 : 1;
    if (!key) return rows;
    return [...rows].sort((a, b) => {
      const x = a[key], y = b[key];
      if (x === y) return 0;
      if (x === null || x === undefined) return 1;  // unknown values are last, in either direction
      if (y === null || y === undefined) return -1;
      return sign * (typeof x === "number" ? x - y : String(x).localeCompare(String(y)));
    });
  }

  function csv(rows) {
    const names = Object.keys(rows[0] || {}).filter(name => !["mark", "key", "slug", "citation"].includes(name));
    const cell = v => (v === null || v === undefined ? "" : /[",\n]/.test(String(v)) ? `"${String(v).replaceAll('"', '""')}"` : String(v));
    return [names.join(","), ...rows.map(row => names.map(name => cell(row[name])).join(","))].join("\n") + "\n";
  }

  const parquet = (slug, name) => element("a.quiet", { href: `site/data/${encodeURIComponent(slug)}/runs.parquet`, download: `${slug}-runs.parquet` }, name);

  springbench.views.runs = async (content, query, index) => {
    const all = await springbench.rows();
    const known = key => all.some(row => row[key] !== null && row[key] !== undefined && row[key] !== "");
    const several = key => new Set(all.map(row => row[key])).size > 1;
    const hidden = new Set([...["outcome", "strain_p99", "integrator_share", "picture"].filter(key => !known(key)), ...(several("sweep") ? [] : ["sweep"])]);
    if (hidden.has("picture")) hidden.add("shot");
    const columns = COLUMNS.filter(column => !hidden.has(column.id));
    let shown = all, selected = new Set(), now = query;

    const facets = FACETS.filter(([key]) => !hidden.has(key) && known(key) && (several(key) || query.get(key))).map(([key, title]) => {
      const select = element("select", { id: `facet-${key}`, onchange: event => change({ [key]: event.target.value }) });
      return { key, title, select, field: element("label.field", { for: select.id }, element("span", {}, title), select) };
    });
    const search = element("input", { type: "search", id: "search", placeholder: "scene, solver, option, reason", oninput: event => change({ q: event.target.value }) });
    const limits = LIMITS.map(([key, title]) => {
      const input = element("input", { type: "number", min: 0, step: "any", id: `max-${key}`, oninput: event => change({ [`max-${key}`]: event.target.value }) });
      return { key, input, field: element("label.field", { for: input.id }, element("span", {}, title), input) };
    });
    const clear = element("button.quiet", { type: "button", onclick: () => { location.hash = address("runs", { sel: now.get("sel"), sort: now.get("sort") }); } }, "Clear");
    const total = element("p.total", { role: "status" }), by = element("p.by"), note = element("p.note.muted");
    const downloads = element("span.downloads");
    const more = element("details.more", { open: LIMITS.some(([key]) => query.get(`max-${key}`)) }, element("summary", {}, "Limits"), element("div.fields", {}, ...limits.map(l => l.field)));
    const filters = element("details.filters", { open: innerWidth > 760 }, element("summary", {}, "Filters"),
      element("div.fields", {}, element("label.field.wide", { for: "search" }, element("span", {}, "Search"), search), ...facets.map(f => f.field), more, clear));
    const chosen = element("div.chosen", { role: "region", "aria-label": "Chosen to compare" });
    const table = springbench.table({
      columns,
      onOpen: row => change({ run: row.key }, true),
      onSelect: row => {
        const next = new Set((springbench.where().query.get("sel") || "").split(",").filter(Boolean));
        if (!next.delete(row.key)) next.add(row.key);
        change({ sel: [...next].join(",") });
      },
      onSort: id => {
        const numeric = columns.find(column => column.id === id).numeric;
        const before = now.get("sort") || "";
        change({ sort: before === id ? `-${id}` : before === `-${id}` && !numeric ? "" : before === `-${id}` ? "" : id });
      },
    });
    const panel = element("aside.panel", { hidden: true, "aria-label": "Run", tabIndex: -1 });
    content.append(element("div.runs", {}, element("div.left", {}, element("h1.unseen", {}, "Runs"), filters,
      element("div.toolbar", {}, total, by, downloads), note, table.grid, chosen), panel));
    let opened = null, requested = null;

    async function update(next) {
      const filter = [...next].filter(([key]) => key !== "sel" && key !== "run").join("&");
      now = next;
      const changes = {};
      if (requested !== filter) {
        requested = filter;
        const sort = next.get("sort") || "";
        shown = sorted(all.filter(row => fits(row, next)), sort);
        changes.rows = shown;
        changes.sort = [sort.replace("-", ""), sort.startsWith("-")];
        total.textContent = shown.length === all.length ? many(all.length, "run") : `${count(shown.length)} of ${many(all.length, "run")}`;
        by.textContent = shown.length ? madeBy([...shown].sort((a, b) => (b.started_at || "").localeCompare(a.started_at || ""))) : "";
        note.textContent = shown.some(row => row.preempted) ? `! ${DOUBT}` : "";
        for (const { key, select } of facets) {
          const sizes = new Map();
          for (const row of all) if (fits(row, next, key)) sizes.set(value(row, key), (sizes.get(value(row, key)) || 0) + 1);
          const names = [...sizes.keys()].filter(Boolean).sort((a, b) => a.localeCompare(b, "en", { numeric: true }));
          const current = next.get(key) || "";
          if (current && !names.includes(current)) names.push(current);
          select.replaceChildren(element("option", { value: "" }, "all"), ...names.map(name =>
            element("option", { value: name, selected: name === current }, `${key === "sweep" ? springbench.sweepOf(name)?.name ?? name : name} (${sizes.get(name) || 0})`)));
        }
        if (document.activeElement !== search) search.value = next.get("q") || "";
        for (const { key, input } of limits) if (document.activeElement !== input) input.value = next.get(`max-${key}`) || "";
        const slugs = [...new Set(shown.map(row => row.slug))];
        downloads.replaceChildren(
          element("button.quiet", { type: "button", onclick: () => save("runs.csv", csv(shown), "text/csv") }, "CSV"),
          slugs.length > 1 ? element("details.menu", {}, element("summary.quiet", {}, "Parquet"), element("div", {}, ...slugs.map(slug => parquet(slug, springbench.sweepOf(slug).name))))
            : element("span", {}, ...slugs.map(slug => parquet(slug, "Parquet"))));
      }
      selected = changes.selected = new Set((next.get("sel") || "").split(",").filter(Boolean));
      changes.opened = next.get("run") || "";
      chosen.hidden = !selected.size;
      chosen.replaceChildren(element("span", {}, `${selected.size} chosen`),
        selected.size > 1 ? element("a.button.strong", { href: address("compare", { sel: [...selected].join(",") }) }, "Compare") : element("span.muted", {}, "choose another to compare"),
        element("button.quiet", { type: "button", onclick: () => change({ sel: "" }) }, "Clear"));
      table.update(changes);
      if (opened !== changes.opened) {
        const before = opened;
        opened = changes.opened;
        panel.hidden = !opened;
        panel.replaceChildren();
        if (opened) await springbench.detail(panel, opened, { close: () => { change({ run: "" }, true); table.grid.focus(); } });
        if (opened && before !== null) panel.focus({ preventScroll: innerWidth > 760 });
      }
    }
    await update(query);
    return { update, leave: table.leave };
  };
})();
