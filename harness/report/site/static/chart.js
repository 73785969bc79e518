// Line and point charts for all plots: by Plotly, with a custom legend, tooltip and keyboard control.
"use strict";
springbench.chart = (() => {
  const { element, script, own, number, percent, time, colour, glyph, replaceLater, where } = springbench;
  const tip = element("div.tip", { hidden: true, role: "tooltip" });
  const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const at = (item, column, k) => (Array.isArray(item[column]) ? item[column][k] : item[column]);

  const figure = (value, format) => (typeof value === "string" ? value : format === "time" ? time(value) : format === "percent" || format === "strain" ? percent(value) : number(value));
  const older = (item, k) => Boolean(Array.isArray(item.stale) ? item.stale[k] : item.stale);

  function describePoint(chart, item, k) {
    const rows = chart.hover.map(([column, words, format]) => {
      const value = at(item, column, k);
      return value === null || value === undefined ? null : element("tr", {}, element("td", {}, words), element("td", {}, figure(value, format)));
    });
    if (older(item, k)) rows.push(element("tr", {}, element("td", {}, "code"), element("td", {}, "other than the newest rows'")));
    return [element("b", {}, item.label), item.description, element("table", {}, element("tbody", {}, ...rows.filter(Boolean)))];
  }

  // Logarithmic axes of iterations show iteration 0 at this value, left of iteration 1.
  const ZERO_PLACE = 0.4;
  const drawnAt = (axis, v) => (axis.shows_zero && v === 0 ? ZERO_PLACE : v);

  // Plotly omits a tick suffix between powers of ten; so times are formatted with seconds as the currency, such as 5ms.
  const SECONDS = { en: { format: { currency: ["", "s"] } } };

  // Show the tooltip next to the point and inside the window.
  function show(x, y, content) {
    tip.replaceChildren(...content);
    if (!tip.isConnected) document.body.append(tip);
    tip.hidden = false;
    const { width, height } = tip.getBoundingClientRect();
    tip.style.left = `${x + 18 + width < innerWidth ? x + 18 : Math.max(6, x - width - 18)}px`;
    tip.style.top = `${Math.max(6, y - height - 14 > 60 ? y - height - 14 : y + 18)}px`;
  }
  const hide = () => { tip.hidden = true; };
  addEventListener("hashchange", hide);

  function trace(chart, item, x, y, panel, tail) {
    const mark = item.style ?? own(chart.styles, item.label), ink = colour(mark.color), shape = item.shape, points = shape === "points";
    const ends = ["", "_low", "_high"].map(end => item[`${x.column}${end}`]), upright = ["", "_low", "_high"].map(end => item[`${y.column}${end}`]);
    // Intervals of many points would cover their line.
    const bars = some => (some[1] && some[2] && (points || some[0].length <= 24) ? {
      type: "data", symmetric: false, color: ink, thickness: 1.2, width: 3,
      array: some[2].map((v, k) => v - some[0][k]), arrayminus: some[1].map((v, k) => some[0][k] - v),
    } : undefined);
    // Results of other code than the newest are hollow.
    const hollow = item[x.column].map((_, k) => older(item, k));
    return {
      x: item[x.column].map(v => drawnAt(x, v)), y: item[y.column], name: item.label, xaxis: `x${tail}`, yaxis: `y${tail}`, meta: { item },
      mode: mark.symbol === "none" ? "lines" : points ? "markers" : "lines+markers", hoverinfo: "none", error_x: bars(ends), error_y: bars(upright),
      line: { color: ink, dash: mark.dash, width: 1.7, shape: shape === "hv" ? "hv" : undefined },
      // The number of markers per line is limited, whatever the number of its points.
      marker: { symbol: hollow.map(yes => mark.symbol + (yes ? "-open" : "")), color: ink, size: 8 * (item.scale ?? 1), maxdisplayed: points ? 0 : shape === "hv" ? 4 : 9, line: { width: hollow.map(yes => (yes || mark.symbol === "line-ns" ? 1.6 : 0)), color: ink } },
    };
  }

  function failed(item, x, y, tail, ink) {
    const k = item[y.column].findLastIndex((v, j) => v !== null && item[x.column][j] !== null);
    return k < 0 ? [] : [{
      x: [drawnAt(x, item[x.column][k])], y: [item[y.column][k]], xaxis: `x${tail}`, yaxis: `y${tail}`, mode: "markers", hoverinfo: "skip",
      marker: { symbol: "x-thin", size: 12, line: { width: 2.4, color: ink } },
    }];
  }

  // The shaded ranges, marked values and words at points of a panel; the words belong to the first quantity of y.
  function marks(chart, items, x, y, tail) {
    const shapes = [], annotations = [], frames = new Set(items.map(item => chart.frames?.[item.frame]));
    const log = (axis, v) => (axis.axis.type === "log" ? Math.log10(v) : v);
    for (const frame of frames) for (const [name, other, axis] of [["x", "y", x], ["y", "x", y]]) {
      const whole = { layer: "below", [`${other}ref`]: `${other}${tail} domain`, [`${name}ref`]: `${name}${tail}`, [`${other}0`]: 0, [`${other}1`]: 1 };
      // A band from 0 has no lower end on a logarithmic axis: it begins below all data.
      const least = high => Math.min(high, ...items.flatMap(item => item[axis.column].filter(v => v > 0))) / 2;
      for (const [low, high] of frame?.bands[axis.column] || []) shapes.push({ ...whole, type: "rect", [`${name}0`]: axis.axis.type === "log" ? Math.max(low, least(high)) : low, [`${name}1`]: high, line: { width: 0 }, fillcolor: css("--hair") });
      for (const [at, words] of frame?.lines[axis.column] || []) {
        shapes.push({ ...whole, type: "line", [`${name}0`]: at, [`${name}1`]: at, line: { width: 1, dash: "dash", color: css("--muted") } });
        const place = name === "y" ? { xanchor: "right", yanchor: "bottom" } : { xanchor: "left", yanchor: "top", textangle: -90 };
        if (words) annotations.push({ text: words, [`${other}ref`]: `${other}${tail} domain`, [`${name}ref`]: `${name}${tail}`, [other]: 1, [name]: log(axis, at), ...place, showarrow: false, font: { size: 12, color: css("--muted") } });
      }
    }
    for (const item of y === chart.y?.[0] ? items : []) for (const [k, words] of Object.entries(item.callouts || {})) {
      const [left, up] = [item[x.column][k], item[y.column][k]];
      if (left !== null && up !== null) annotations.push({ text: words, xref: `x${tail}`, yref: `y${tail}`, x: log(x, drawnAt(x, left)), y: log(y, up), ax: 24, ay: -18, arrowcolor: css("--muted"), arrowhead: 0, font: { size: 12, color: css("--ink") } });
    }
    return { shapes, annotations };
  }

  // The visible range of the axes as a URL parameter, such as "x:0,2;y:-3,1"; empty if everything is visible.
  const zoomed = layout => Object.keys(layout).filter(key => /^[xy]axis\d*$/.test(key) && layout[key].autorange === false && layout[key].range)
    .map(key => `${key.replace("axis", "")}:${layout[key].range.map(v => Number(Number(v).toPrecision(5))).join(",")}`).join(";");
  function zoom(layout, requested) {
    for (const part of (requested || "").split(";")) {
      const [, axis, low, high] = /^([xy]\d*):([-\d.e+]+),([-\d.e+]+)$/.exec(part) || [], of = axis && layout[axis.replace(/^[xy]/, "$&axis")];
      if (of) Object.assign(of, { range: [Number(low), Number(high)], autorange: false });
    }
  }

  // Draw the items of a chart by the columns x and y, one panel per `item.panel`; zoomKey: parameter of the URL.
  async function draw(plot, chart, items, x, y, { hidden = new Set(), onPoint = () => {}, small = false, zoomKey = "zoom" } = {}) {
    await script("site/plotly.js");
    const panels = [...new Set(items.map(item => item.panel ?? ""))], narrow = plot.clientWidth < 640 && panels.length > 1;
    plot.style.height = narrow ? `${330 * panels.length}px` : "";
    const style = {
      gridcolor: css("--hair"), linecolor: css("--muted"), zeroline: false, zerolinecolor: css("--rule"), exponentformat: "power", minexponent: 4, ticks: "outside", ticklen: 4, tickcolor: css("--rule"),
      tickfont: { color: css("--muted"), size: small ? 11 : 12 }, title: { font: { color: css("--muted"), size: small ? 12 : 13 }, standoff: 8 }, automargin: true,
    };
    const layout = {
      margin: { t: panels[0] ? 30 : 12, l: 20, r: 10, b: 20 }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", hovermode: "closest", hoverdistance: 24, showlegend: false,
      annotations: [], shapes: [], font: { family: getComputedStyle(document.body).fontFamily, color: css("--ink") }, dragmode: matchMedia("(pointer: coarse)").matches ? false : "zoom",
    };
    const traces = [], gap = narrow ? 0.16 : 0.05, n = panels.length;
    // Over few decades 1, 2 and 5 are labelled if there is space, over more only the powers of ten.
    const room = axis => (axis === y ? (narrow ? 330 : plot.clientHeight) / 42 : plot.clientWidth / (narrow ? 1 : panels.length) / 70);
    const range = axis => {
      if (axis.axis.type !== "log") return axis.axis;
      let [low, high] = [Infinity, 0];
      for (const item of items) for (const v of item[axis.column]) if (v > 0) [low, high] = [Math.min(low, v), Math.max(high, v)];
      const decades = Math.log10(high / low);
      if (axis.shows_zero && items.some(item => item[axis.column].includes(0))) {
        // A tick at iteration 0 and at each power of ten; over few decades also at 2 and 5 times these.
        const ticks = [0];
        for (let power = 1; power <= high; power *= 10) for (const v of high < 100 ? [1, 2, 5] : [1]) if (v * power <= high) ticks.push(v * power);
        return { ...axis.axis, tickmode: "array", tickvals: ticks.map(v => drawnAt(axis, v)), ticktext: ticks.map(v => number(v)) };
      }
      if (axis.axis.tickmode === "array") {
        // A tick at each size, the largest first, if there is space for its label.
        const sizes = [...new Set(items.flatMap(item => item[axis.column]))].filter(v => v > 0).sort((a, b) => b - a), ticks = [];
        for (const v of sizes) if (!ticks.length || Math.log10(ticks.at(-1) / v) * room(axis) >= decades) ticks.push(v);
        return { ...axis.axis, tickvals: ticks, ticktext: ticks.map(v => number(v)) };
      }
      return { ...axis.axis, dtick: decades < 0.7 ? undefined : 3 * decades > Math.min(7.2, room(axis)) ? Math.max(1, Math.ceil(decades / room(axis))) : "D2" };
    };
    panels.forEach((panel, k) => {
      const tail = k ? k + 1 : "", size = (1 + gap) / n - gap, low = k * (size + gap);
      const across = narrow ? [0, 1] : [low, Math.min(1, low + size)], up = narrow ? [Math.max(0, 1 - low - size), 1 - low] : [0, 1];
      layout[`xaxis${tail}`] = { ...style, ...range(x), title: { ...style.title, text: narrow && k < n - 1 ? "" : x.title }, domain: across, anchor: `y${tail}` };
      layout[`yaxis${tail}`] = { ...style, ...range(y), title: { ...style.title, text: k && !narrow ? "" : y.title }, domain: up, anchor: `x${tail}`, matches: k ? "y" : undefined, showticklabels: !k || narrow };
      if (panel && n > 0) layout.annotations.push({ text: `<b>${panel}</b>`, x: across[0], y: up[1], yshift: 22, xref: "paper", yref: "paper", showarrow: false, xanchor: "left", font: { size: 13, color: css("--ink") } });
      const here = items.filter(item => (item.panel ?? "") === panel && !hidden.has(item.label)), extra = marks(chart, here, x, y, tail);
      const frame = chart.frames?.[items.find(item => (item.panel ?? "") === panel).frame];
      if (frame?.x_label) layout[`xaxis${tail}`].title.text = frame.x_label;
      for (const [name, axis] of [["x", x], ["y", y]]) if (frame?.place_names[axis.column]) layout[`${name}axis${tail}`].categoryarray = frame.place_names[axis.column];
      layout.shapes.push(...extra.shapes);
      layout.annotations.push(...extra.annotations);
      for (const item of here) {
        traces.push(trace(chart, item, x, y, panel, tail));
        if (item.status && item.status !== "ok") traces.push(...failed(item, x, y, tail, colour((item.style ?? own(chart.styles, item.label)).color)));
      }
    });
    zoom(layout, where().query.get(zoomKey));
    await Plotly.react(plot, traces, layout, { displayModeBar: false, responsive: true, showTips: false, locales: SECONDS });
    plot.removeAllListeners("plotly_hover");
    plot.removeAllListeners("plotly_unhover");
    plot.removeAllListeners("plotly_click");
    plot.removeAllListeners("plotly_relayout");
    plot.on("plotly_relayout", () => replaceLater({ [zoomKey]: zoomed(plot.layout) }));
    plot.on("plotly_hover", ({ points: [p], event }) => {
      if (!p.data.meta) return;
      const box = plot.getBoundingClientRect();
      const [left, top] = [p.xaxis._offset + p.xaxis.d2p(p.x) + box.left, p.yaxis._offset + p.yaxis.d2p(p.y) + box.top];
      show(left, top, describePoint(chart, p.data.meta.item, p.pointNumber));
    });
    plot.on("plotly_unhover", hide);
    plot.on("plotly_click", ({ points: [p] }) => { if (p.data.meta) onPoint(p.data.meta.item, p.pointNumber); });
    keys(plot, chart, x, y, onPoint);
  }

  // Left and right move along a line, up and down to the next line, Enter opens the point, plus and minus zoom, Home
  // resets the zoom.
  function keys(plot, chart, x, y, onPoint) {
    let line = -1, k = 0;
    plot.onkeydown = event => {
      const lines = plot.data.map((one, number) => [one, number]).filter(([one]) => one.meta);
      const step = { ArrowRight: [0, 1], ArrowLeft: [0, -1], ArrowDown: [1, 0], ArrowUp: [-1, 0] }[event.key];
      if (event.key === "Enter" && line >= 0) onPoint(lines[line][0].meta.item, k);
      else if (event.key === "Home") Plotly.relayout(plot, Object.fromEntries(Object.keys(plot.layout).filter(key => /^[xy]axis/.test(key)).map(key => [`${key}.autorange`, plot.layout[key].autorange === "reversed" ? "reversed" : true])));
      else if (event.key === "+" || event.key === "-") Plotly.relayout(plot, Object.fromEntries(Object.keys(plot.layout).filter(key => /^[xy]axis/.test(key)).map(key => {
        const [a, b] = plot._fullLayout[key].range, middle = (a + b) / 2, by = event.key === "+" ? 0.35 : 0.7;
        return [`${key}.range`, [middle - by * (b - a), middle + by * (b - a)]];
      })));
      else if (step && lines.length) {
        line = line < 0 ? 0 : (line + step[0] + lines.length) % lines.length;
        const [one, curve] = lines[line];
        for (let tries = 0; tries <= one.x.length; tries++) {
          k = (k + (step[1] || (tries ? 1 : 0)) + one.x.length) % one.x.length;
          if (one.x[k] !== null && one.y[k] !== null) break;
        }
        const full = plot._fullData[curve], box = plot.getBoundingClientRect(), axes = [plot._fullLayout[full.xaxis.replace("x", "xaxis")], plot._fullLayout[full.yaxis.replace("y", "yaxis")]];
        show(axes[0]._offset + axes[0].d2p(one.x[k]) + box.left, axes[1]._offset + axes[1].d2p(one.y[k]) + box.top, describePoint(chart, one.meta.item, k));
        springbench.announce(`${one.name}: ${figure(one.meta.item[x.column][k], x.format)}, ${figure(one.y[k], y.format)}`);
      } else return;
      event.preventDefault();
    };
    plot.onblur = hide;
  }

  // Labels with their markers; each toggles a series.
  function legend(labels, chart, items, hidden, onChange) {
    return labels.map(label => {
      const source = own(chart.citations, label), drawn = items.some(item => item.label === label && item[chart.x[0].column].some(v => v !== null));
      return element("li", {}, element("button", {
        type: "button", "aria-pressed": String(!hidden.has(label)), title: source?.citation,
        onclick: event => {
          const next = new Set(hidden);
          if (event.shiftKey || event.detail === 2) {
            labels.forEach(one => next.add(one));
            next.delete(label);
          } else if (!next.delete(label)) next.add(label);
          onChange(next);
        },
      }, glyph(own(chart.styles, label)), element("span", {}, label, !drawn && element("span.muted", {}, " – nothing to draw"))));
    });
  }

  return { draw, legend, hide, figure };
})();
