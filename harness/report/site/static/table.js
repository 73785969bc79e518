// Virtualised table: only visible rows are elements; an ARIA grid for keyboard and screen readers.
"use strict";
springbench.table = ({ columns, onOpen, onSelect, onSort }) => {
  const { element } = springbench;
  const AROUND = 6;
  const head = element("div.tr.th", { role: "row", "aria-rowindex": 1 });
  const body = element("div.body", { role: "rowgroup" });
  const grid = element("div.grid", { role: "grid", tabIndex: 0, "aria-label": "Runs", "aria-multiselectable": "true" },
    element("div.headgroup", { role: "rowgroup" }, head), body);
  const heads = columns.map(column => {
    const cell = element(`div.td.c-${column.id}`, { role: "columnheader", title: column.meaning });
    if (column.sort === false) cell.append(element("span.unseen", {}, column.title));
    else cell.append(element("button", { type: "button", onclick: () => onSort(column.id) }, column.title));
    return cell;
  });
  head.append(...heads);
  let shownColumns = columns, rows = [], selected = new Set(), active = 0, opened = "", first = -1, last = -1, high = 44;

  function line(row, k) {
    const cells = shownColumns.map(column => {
      const cell = element(`div.td.c-${column.id}${column.numeric ? ".num" : ""}`, { role: "gridcell" });
      cell.append(column.show(row, selected.has(row.key)) ?? "");
      return cell;
    });
    return element("div.tr", {
      role: "row", id: `row-${k}`, "aria-rowindex": k + 2, "aria-selected": String(selected.has(row.key)),
      style: `transform: translateY(${k * high}px)`, onclick: event => click(event, k),
    }, ...cells);
  }

  function paint(isNew = false) {
    const from = Math.max(0, Math.floor((grid.scrollTop - head.offsetHeight) / high) - AROUND);
    const to = Math.min(rows.length, Math.ceil((grid.scrollTop + grid.clientHeight) / high) + AROUND);
    if (!isNew && from === first && to === last) return;
    [first, last] = [from, to];
    body.replaceChildren(...rows.slice(from, to).map((row, k) => line(row, from + k)));
    mark();
  }

  function mark() {
    for (const one of body.children) {
      const k = one.ariaRowIndex - 2;
      one.classList.toggle("active", k === active);
      one.classList.toggle("opened", rows[k]?.key === opened);
    }
    if (document.getElementById(`row-${active}`)) grid.setAttribute("aria-activedescendant", `row-${active}`);
    else grid.removeAttribute("aria-activedescendant");
  }

  function click(event, k) {
    active = k;
    if (event.target.closest("a")) return;
    if (event.target.closest(".c-check")) onSelect(rows[k]);
    else onOpen(rows[k]);
    mark();
  }

  function move(to) {
    active = Math.max(0, Math.min(rows.length - 1, to));
    const top = active * high, room = grid.clientHeight - head.offsetHeight;
    if (top < grid.scrollTop) grid.scrollTop = top;
    else if (top + high > grid.scrollTop + room) grid.scrollTop = top + high - room;
    paint();
    mark();
  }

  grid.addEventListener("scroll", () => paint(), { passive: true });
  grid.addEventListener("keydown", event => {
    if (event.target !== grid) return;
    const page = Math.max(1, Math.floor(grid.clientHeight / high) - 2);
    const by = { ArrowDown: 1, ArrowUp: -1, PageDown: page, PageUp: -page, Home: -rows.length, End: rows.length }[event.key];
    if (by) move(active + by);
    else if (event.key === "Enter" && rows[active]) onOpen(rows[active]);
    else if (event.key === " " && rows[active]) onSelect(rows[active]);
    else return;
    event.preventDefault();
  });
  // Columns without space are removed, the least important first; the panel of a run shows all figures.
  function fit() {
    const least = some => some.reduce((sum, column) => sum + parseFloat(column.width.match(/\d+/)[0]), 48);
    let some = columns;
    for (const column of columns.filter(one => one.spare).sort((a, b) => b.spare - a.spare)) {
      if (least(some) <= grid.clientWidth || innerWidth <= 760) break;
      some = some.filter(one => one !== column);
    }
    heads.forEach((cell, k) => { cell.hidden = !some.includes(columns[k]); });
    shownColumns = some;
    grid.style.setProperty("--columns", some.map(column => column.width).join(" "));
    grid.style.setProperty("--least", `${least(some) - 48}px`);
  }
  const sized = new ResizeObserver(() => {
    fit();
    const before = high;
    high = parseFloat(getComputedStyle(grid).getPropertyValue("--row")) || 44;
    body.style.height = `${rows.length * high}px`;
    paint(true);
    if (high !== before && opened) move(active);
  });
  sized.observe(grid);

  return {
    grid,
    leave: () => sized.disconnect(),
    update(changed) {
      const whole = changed.rows && changed.rows !== rows;
      if (whole) {
        rows = changed.rows;
        active = 0;
        grid.scrollTop = 0;
        grid.setAttribute("aria-rowcount", rows.length + 1);
        body.style.height = `${rows.length * high}px`;
      }
      selected = changed.selected ?? selected;
      opened = changed.opened ?? opened;
      const [by, down] = changed.sort ?? [];
      heads.forEach((cell, k) => {
        if (columns[k].id === by) cell.setAttribute("aria-sort", down ? "descending" : "ascending");
        else if (changed.sort) cell.removeAttribute("aria-sort");
      });
      if (whole && opened) {
        const at = rows.findIndex(row => row.key === opened);
        if (at >= 0) move(at);
      }
      paint(true);
    },
  };
};
