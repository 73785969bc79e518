// Robustness map: solvers in columns, cases in rows, coloured by outcome; arrow keys move between the cells.
"use strict";
springbench.map = (chart, sweep) => {
  const { element, own, address } = springbench;
  const at = new Map(chart.cells.map(cell => [`${cell[0]}\n${cell[1]}`, cell]));
  const dark = hex => [1, 3, 5].reduce((sum, k, i) => sum + [0.2126, 0.7152, 0.0722][i] * (parseInt(hex.slice(k, k + 2), 16) / 255) ** 2.2, 0) < 0.18;
  const tell = element("p", { role: "status" }, "Point at a cell, or go there by arrow keys, for its reason; it leads to the run.");

  function cell(found) {
    const outcome = chart.outcomes[found[2]], words = `${found[0]}, ${found[1]}: ${outcome.label}. ${found[4]}`;
    const read = () => { tell.textContent = words; };
    return element("td", {}, element("button", {
      type: "button", tabIndex: -1, title: words, "aria-label": words, onmouseenter: read, onfocus: read,
      style: `background:${outcome.color};color:${dark(outcome.color) ? "#ffffff" : "#16181b"}`,
      onclick: () => { location.hash = address("runs", { sweep: sweep.slug, run: `${sweep.slug}/${found[5]}` }); },
    }, found[3] || "\u00a0"));
  }

  const head = element("tr", {}, element("th", {}, element("b", {}, "case")), ...chart.solvers.map(name => element("th", { scope: "col", title: own(chart.citations, name) }, element("span", {}, name))));
  const shares = [["right", s => (s.correct_share === null ? "" : `${Math.round(100 * s.correct_share)} %`)], ["finite", s => (s.finite_share === null ? "" : `${Math.round(100 * s.finite_share)} %`)], ["worst", s => s.worst_error]].map(([name, words]) =>
    element("tr", {}, element("th", { scope: "row" }, element("b", {}, name)), ...chart.scores.map(s => element("td.share", {}, words(s)))));
  let family = "";
  const rows = chart.cases.flatMap(name => {
    const [first, rest] = [name.split("-")[0], name.split("-").slice(1).join("-")], lines = [];
    if (first !== family) {
      family = first;
      lines.push(element("tr.family", {}, element("th", { scope: "rowgroup", colSpan: chart.solvers.length + 1 }, first)));
    }
    lines.push(element("tr", {}, element("th", { scope: "row" }, rest || name), ...chart.solvers.map(solver => {
      const found = at.get(`${name}\n${solver}`);
      return found ? cell(found) : element("td");
    })));
    return lines;
  });
  const table = element("table.map", {}, element("thead", {}, head), element("tbody", {}, ...shares, ...rows));
  const first = table.querySelector("td button");
  if (first) first.tabIndex = 0;
  table.addEventListener("keydown", event => {
    const from = event.target.closest("td"), step = { ArrowRight: [0, 1], ArrowLeft: [0, -1], ArrowDown: [1, 0], ArrowUp: [-1, 0] }[event.key];
    if (!from || !step) return;
    event.preventDefault();
    let line = from.parentElement, column = from.cellIndex, next = null;
    do {
      line = step[0] ? (step[0] > 0 ? line.nextElementSibling : line.previousElementSibling) : line;
      column += step[1];
      next = line?.cells[column]?.querySelector("button");
    } while (line && column > 0 && column <= chart.solvers.length && !next);
    if (!next) return;
    event.target.tabIndex = -1;
    next.tabIndex = 0;
    next.focus();
  });
  const key = element("ul.key", {}, ...chart.outcomes.filter(o => o.count).map(o => element("li", { title: o.description }, element("span", { style: `background:${o.color}` }), `${o.label} (${o.count})`)));
  return [element("p", {}, element("b", {}, chart.headline)), key, tell, element("div.mapbox", {}, table)];
};
