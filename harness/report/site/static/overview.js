// Overview: what was run, with provenance, current findings, and failures with their causes.
"use strict";
(() => {
  const { element, put, link, address, commit, many, count, duration, day, state } = springbench;

  function facts(sweep) {
    const parts = [];
    if (sweep.runs) parts.push(many(sweep.runs, "run"));
    if (sweep.curves) parts.push(many(sweep.curves, "solve"));
    if (sweep.work_points) parts.push(many(sweep.work_points, "simulation"));
    if (sweep.ablations) parts.push(many(sweep.ablations, "verdict"));
    if (sweep.benchmarks) parts.push(many(sweep.benchmarks, "benchmark"));
    if (sweep.sizes?.length) parts.push(`size${sweep.sizes.length > 1 ? `s ${sweep.sizes[0]} to ${sweep.sizes.at(-1)}` : ` ${sweep.sizes[0]}`}`);
    if (sweep.total_seconds) parts.push(`${duration(sweep.total_seconds)} timed`);
    return parts.join(" · ");
  }

  function outcome(sweep) {
    const parts = Object.entries(sweep.statuses || {}).map(([status, n]) => state(status, `${count(n)} ${status}`));
    if (sweep.num_stale_runs) parts.push(element("span.state.mild", {}, element("span", { "aria-hidden": "true" }, "↻ "), `${count(sweep.num_stale_runs)} by other code`));
    return parts;
  }

  function made(sweep) {
    return sweep.provenance.slice(0, 3).map(m => element("div", {},
      `${m.cpu || "unknown processor"}, ${many(m.cores || 0, "core")}${m.memory_gib ? `, ${m.memory_gib} GiB` : ""}`, element("br"),
      element("span.muted", {}, `code `, element("code", {}, commit(m.commit)),
        `${m.machine_id ? ` · machine ${m.machine_id.slice(0, 6)}` : ""} · ${day(m.first_started_at) === day(m.last_started_at) ? day(m.last_started_at) : `${day(m.first_started_at)} to ${day(m.last_started_at)}`}`)));
  }

  function linkOf(sweep, finding) {
    if (finding.plot) return address("plots", { sweep: sweep.slug, plot: finding.plot, ...finding.filter });
    if (finding.filter) return address("runs", { sweep: sweep.slug, ...finding.filter });
    if (finding.runs?.length > 1) return address("compare", { sel: finding.runs.map(id => `${sweep.slug}/${id}`).join(",") });
    if (finding.runs?.length) return address("runs", { sweep: sweep.slug, run: `${sweep.slug}/${finding.runs[0]}` });
    return null;
  }

  function findings(sweep) {
    const some = sweep.findings, list = element("ul.findings");
    const line = finding => {
      const one = linkOf(sweep, finding), run = finding.runs?.length > 1 && address("runs", { sweep: sweep.slug, run: `${sweep.slug}/${finding.runs[0]}` });
      return element("li", {}, finding.text.replace(/\|/g, " "), one && " ",
        run && element("a", { href: run }, "the run"), run && ", ",
        one && element("a", { href: one }, finding.plot === "hard" ? "the map" : finding.plot ? "the plot" : finding.runs?.length > 1 ? "compare" : "show"));
    };
    list.append(...some.slice(0, 6).map(line));
    if (some.length <= 6) return [list];
    const more = element("ul.findings", {}, ...some.slice(6).map(line));
    return [list, element("details", {}, element("summary", {}, `${many(some.length - 6, "more finding")}`), more)];
  }

  function failures(sweep) {
    if (!sweep.failures.length) return [];
    const rows = sweep.failures.map(cause => {
      const names = some => some.slice(0, 4).map(([name, n]) => (n > 1 ? `${name} (${count(n)})` : name)).join(", ")
        + (some.length > 4 ? ` and ${some.length - 4} more` : "");
      const link = cause.run_id && address("runs", { sweep: sweep.slug, status: cause.status, run: `${sweep.slug}/${cause.run_id}` });
      return element("tr", {}, element("td.num", {}, count(cause.count)), element("td", {}, state(cause.status)),
        element("td.reason", {}, cause.reason, cause.has_varied_reasons && element("span.muted", {}, " and similar"), link && " ", link && element("a", { href: link }, "show")),
        element("td", {}, names(cause.solvers)), element("td", {}, names(cause.scenes)));
    });
    const head = ["runs", "status", "cause", "solvers", "where"].map((words, k) => element(k ? "th" : "th.num", { scope: "col" }, words));
    return [element("h3", {}, "What did not succeed"), element("div.scroll", { tabIndex: 0, role: "region", "aria-label": "What did not succeed" },
      element("table.plain", {}, element("thead", {}, element("tr", {}, ...head)), element("tbody", {}, ...rows)))];
  }

  function pictures(sweep) {
    if (!sweep.pictures.length) return null;
    return element("div.pictures", {}, ...sweep.pictures.map(p => element("figure", {},
      element("a", { href: link(sweep.relative_url, p.path) }, element("img", { src: link(sweep.relative_url, p.path), alt: `Picture: ${p.text}`, loading: "lazy", decoding: "async" })),
      element("figcaption", {}, p.text))));
  }

  function card(sweep) {
    const id = `sweep-${sweep.slug}`;
    const links = [];
    if (sweep.runs) links.push(element("a.button", { href: address("runs", { sweep: sweep.slug }) }, `All ${many(sweep.runs, "run")}`));
    links.push(...sweep.plots.slice(0, 6).map(plot => element("a.button", { href: address("plots", { sweep: sweep.slug, plot: plot.id }) }, plot.title)));
    return element("section.sweep", { "aria-labelledby": id },
      element("div.head", {},
        element("div", {}, element("h2", { id }, sweep.name), element("p.muted", {}, facts(sweep)), element("p.states", {}, ...outcome(sweep))),
        element("div.made", {}, ...made(sweep))),
      ...findings(sweep), element("p.links", {}, ...links), pictures(sweep), ...failures(sweep));
  }

  springbench.views.overview = (content, query, index) => {
    const runs = index.sweeps.reduce((sum, s) => sum + (s.runs || 0), 0);
    const failed = index.sweeps.reduce((sum, s) => sum + s.failures.reduce((n, f) => n + f.count, 0), 0);
    const line = [many(index.sweeps.length, "set of results", "sets of results"), runs && many(runs, "run"), failed && `${count(failed)} did not succeed`,
      `written ${index.written_at.slice(0, 16).replace("T", " ")} UTC`].filter(Boolean).join(" · ");
    put(content, element("div.page", {}, element("h1", {}, index.title), element("p.muted", {}, line),
      ...index.sweeps.map(card),
      index.unwritten_sweeps.length > 0 && element("p.muted", {}, `Not on this page yet: ${index.unwritten_sweeps.join(", ")}. `, element("code", {}, "springbench report"), " adds them.")));
    return { update() {} };
  };
})();
