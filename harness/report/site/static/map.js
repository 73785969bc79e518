// Cell maps as tables, from the JSON of their `CellMap`; a table has headers, focus and arrow keys, a heat map of Plotly none.
// Maps with the same columns share a table.
"use strict";
springbench.maps = (chart, sweep) => {
  const { element, own, address } = springbench;
  const status = element("p", { role: "status" }, "Point at a cell, or go there by arrow keys, for what is known about it.");

  function button(map, cell) {
    const [row, column, number, text, reason, run, stale] = cell, outcome = map.outcomes[number];
    const words = [`${map.title ? `${map.title}, ` : ""}${row}, ${column}: ${outcome.label}.`, reason, stale && "Measured by other code than the newest rows."].filter(Boolean).join(" ");
    const read = () => { status.textContent = words; };
    return element("td", {}, element(`button${stale ? ".stale" : ""}`, {
      type: "button", tabIndex: -1, title: words, "aria-label": words, onmouseenter: read, onfocus: read,
      style: `background:${outcome.color};color:${outcome.text_color}`,
      onclick: () => { if (run) location.hash = address("runs", { sweep: sweep.slug, run: `${sweep.slug}/${run}` }); },
    }, text || "\u00a0"));
  }

  const distinct = (map, k) => [...new Set(map.cells.map(cell => cell[k]))];
  function table(maps) {
    const columns = distinct(maps[0], 1);
    const head = element("tr", {}, element("td"), ...columns.map(name => element("th", { scope: "col", title: own(chart.citations, name)?.citation }, element("span", {}, name))));
    const rows = maps.flatMap(map => {
      const at = new Map(map.cells.map(cell => [`${cell[0]}\n${cell[1]}`, cell]));
      return [...(map.title ? [element("tr.family", {}, element("th", { scope: "rowgroup", colSpan: columns.length + 1 }, map.title))] : []),
        ...distinct(map, 0).map(row => element("tr", {}, element("th", { scope: "row" }, row), ...columns.map(column => {
          const cell = at.get(`${row}\n${column}`);
          return cell ? button(map, cell) : element("td");
        })))];
    });
    const box = element("table.map", {}, element("thead", {}, head), element("tbody", {}, ...rows)), first = box.querySelector("td button");
    if (first) first.tabIndex = 0;
    box.addEventListener("keydown", event => {
      const from = event.target.closest("td"), step = { ArrowRight: [0, 1], ArrowLeft: [0, -1], ArrowDown: [1, 0], ArrowUp: [-1, 0] }[event.key];
      if (!from || !step) return;
      event.preventDefault();
      let line = from.parentElement, column = from.cellIndex, next = null;
      do {
        line = step[0] ? (step[0] > 0 ? line.nextElementSibling : line.previousElementSibling) : line;
        column += step[1];
        next = line?.cells[column]?.querySelector("button");
      } while (line && column > 0 && column <= columns.length && !next);
      if (!next) return;
      event.target.tabIndex = -1;
      next.tabIndex = 0;
      next.focus();
    });
    return element("div.mapbox", {}, box);
  }

  const groups = [];
  for (const map of chart.maps) {
    if (groups.length && String(distinct(groups.at(-1)[0], 1)) === String(distinct(map, 1))) groups.at(-1).push(map);
    else groups.push([map]);
  }
  const counts = new Map(), outcomes = new Map(chart.maps.flatMap(map => map.outcomes.map(one => [one.label, one])));
  for (const map of chart.maps) for (const cell of map.cells) counts.set(map.outcomes[cell[2]].label, (counts.get(map.outcomes[cell[2]].label) || 0) + 1);
  const key = element("ul.key", {}, ...[...outcomes.values()].filter(one => counts.has(one.label)).map(one => element("li", { title: one.description }, element("span", { style: `background:${one.color}` }), `${one.label} (${counts.get(one.label)})`)));
  return chart.maps.length ? [key, status, element("div.maps", {}, ...groups.map(table))] : [];
};
