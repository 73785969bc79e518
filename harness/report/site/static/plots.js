// All plots, one at a time, with the selection of axes in the URL; a point links to its run.
"use strict";
(() => {
  const { element, data, change, address, where, save } = springbench;
  springbench.views.plots = async (content, query, index) => {
    const sweeps = index.sweeps.filter(sweep => sweep.plots.length);
    const box = element("div.plots"), top = element("div.choice.aside"), tabs = element("div.tabs", { role: "navigation", "aria-label": "Plots" });
    const title = element("h1"), note = element("p.muted"), by = element("p.by"), maps = element("div"), choice = element("div.choice"), body = element("div"), point = element("section.point", { hidden: true, tabIndex: -1, "aria-label": "The chosen point" });
    box.append(element("div.headline", {}, title, top), tabs, note, maps, choice, body, by, point);
    content.append(box);
    let last = "", current = null, pointed = "";

    const pick = (words, key, names, value, named = name => name) => element("label.field", {}, element("span", {}, words),
      element("select", { "aria-label": words, onchange: event => change({ [key]: event.target.value, point: "", at: "", turn: "", zoom: "" }) }, ...names.map(name => element("option", { value: name, selected: name === value }, named(name)))));

    async function update(next) {
      const sweep = sweeps.find(one => one.slug === next.get("sweep")) || sweeps[0], plots = sweep.plots;
      const plot = plots.find(one => one.id === next.get("plot")) || plots.find(one => one.id === "convergence") || plots[0];
      const drawn = [...next].filter(([key]) => !["point", "at", "turn"].includes(key)).join("&") + sweep.slug + plot.id;
      const isNew = last.split("\n")[1] !== `${sweep.slug}/${plot.id}`;
      if (drawn !== last.split("\n")[0]) {
        last = `${drawn}\n${sweep.slug}/${plot.id}`;
        const chart = await data(`${sweep.slug}/${plot.id}`);
        title.textContent = chart.title;
        const mixed = chart.items.some(item => (Array.isArray(item.stale) ? item.stale.some(Boolean) : item.stale));
        note.textContent = [chart.note, mixed && "Hollow marks: measured by other code than the newest rows."].filter(Boolean).join(" ");
        by.textContent = `${sweep.name}: ${springbench.madeBy(sweep.provenance)}.`;
        top.hidden = sweeps.length < 2;
        top.replaceChildren(element("label.field", {}, element("span", {}, "Results"), element("select", { onchange: event => { location.hash = address("plots", { sweep: event.target.value }); } },
          ...sweeps.map(one => element("option", { value: one.slug, selected: one === sweep }, one.name)))));
        tabs.replaceChildren(...plots.map(one => element("a", { href: address("plots", { sweep: sweep.slug, plot: one.id }), "aria-current": one === plot && "page" }, one.title)));
        if (isNew) maps.replaceChildren(...(chart.maps ? springbench.maps(chart, sweep) : []));
        if (chart.items.length) await drawChart(sweep, plot, chart, next, isNew);
        else {
          choice.replaceChildren();
          body.replaceChildren();
          current = null;
        }
      }
      await showPoint(sweep, next.get("point") || "", `${next.get("at")} ${next.get("turn")}`);
    }

    async function drawChart(sweep, plot, chart, next, isNew) {
      const distinct = key => [...new Set(chart.items.map(item => item[key]))], chosen = {};
      for (const key of chart.filters) {
        const names = distinct(key), requested = next.get(key);
        chosen[key] = names.includes(requested) || requested === "all" ? requested : names[0];
      }
      const one = (axes, name) => axes.find(a => a.column === name) || axes[0], x = one(chart.x, next.get("x")), y = one(chart.y, next.get("y"));
      const items = chart.items.filter(item => chart.filters.every(key => chosen[key] === "all" || item[key] === chosen[key]));
      const notes = new Set(items.flatMap(item => chart.frames?.[item.frame].notes || []));
      note.textContent = [note.textContent, ...notes].join(" ");
      const hidden = new Set((next.get("off") || "").split("~").filter(Boolean)), labels = [...new Set(items.map(item => item.label))];
      const words = { problem: "Step", scene: "Scene", gap: "To a gap of", curve: "Of the paper", solver: "Solver", benchmark: "Benchmark" };
      const plotBox = isNew || !current ? element("div.plot", { tabIndex: 0, role: "group", "aria-label": `Plot: ${chart.title}. Arrow keys go through its points, Enter opens one, plus and minus zoom, Home shows all.` }) : current.plotBox;
      const names = element("ul.legend", { "aria-label": "Solvers" }, ...springbench.chart.legend(labels, chart, items, hidden, off => change({ off: [...off].join("~") })));
      choice.replaceChildren(...chart.filters.filter(key => distinct(key).length > 1).map(key => pick(words[key] || key, key, distinct(key), chosen[key])),
        ...(chart.y.length > 1 ? [pick("Shown", "y", chart.y.map(a => a.column), y.column, name => one(chart.y, name).title)] : []),
        ...(chart.x.length > 1 ? [pick("Against", "x", chart.x.map(a => a.column), x.column, name => one(chart.x, name).title)] : []),
        element("button.quiet", { type: "button", onclick: () => Plotly.downloadImage(plotBox, { format: "svg", filename: `${sweep.slug}-${plot.id}` }) }, "SVG"),
        element("button.quiet", { type: "button", onclick: () => save(`${sweep.slug}-${plot.id}.csv`, csv(items, x, y), "text/csv") }, "CSV"),
        hidden.size > 0 && element("button.quiet", { type: "button", onclick: () => change({ off: "" }) }, "Show all") || "");
      if (plotBox !== current?.plotBox) body.replaceChildren(element("div.frame", {}, plotBox, names));
      else body.querySelector(".legend").replaceWith(names);
      const redraw = () => springbench.chart.draw(plotBox, chart, items, x, y, {
        hidden, onPoint: (item, k) => change({ point: `${chart.items.indexOf(item)}.${k}`, at: "", turn: "" }, true),
      });
      current = { plotBox, chart, redraw };
      await redraw();
    }

    async function showPoint(sweep, requested, how) {
      if (`${requested} ${how}` === pointed) return;
      const another = requested !== pointed.split(" ")[0];
      pointed = `${requested} ${how}`;
      point.replaceChildren();
      const [number, k] = requested.split(".").map(Number), item = requested && current?.chart.items[number];
      point.hidden = !item;
      if (!item) return;
      const close = () => { change({ point: "", at: "", turn: "" }); current.plotBox.focus(); };
      if (item.runs) await springbench.detail(point, `${sweep.slug}/${item.runs[k]}`, { close });
      else await springbench.solve(point, sweep, current.chart, item, k, close);
      if (!another) return;
      point.scrollIntoView({ block: "nearest" });
      point.focus({ preventScroll: true });
    }

    const recolour = () => { if (current) { last = ""; update(where().query); } };
    addEventListener("recolour", recolour);
    await update(query);
    return { update, leave: () => { removeEventListener("recolour", recolour); springbench.chart.hide(); } };
  };

  function csv(items, x, y) {
    const quote = v => (v === null || v === undefined ? "" : /[",]/.test(String(v)) ? `"${String(v).replaceAll('"', '""')}"` : v);
    const lines = items.flatMap(item => item[x.column].map((value, k) => [item.label, item.description, value, item[y.column][k]].map(quote).join(",")));
    const named = axis => axis.title + (axis.format === "time" ? " [s]" : "");
    return [["solver", "what", named(x), named(y)].map(quote).join(","), ...lines].join("\n") + "\n";
  }
})();
