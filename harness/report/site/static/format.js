// Formatting of numbers, markers and names.
"use strict";
Object.assign(springbench, (() => {
  const { element, isDark, own } = springbench;
  const power = text => text.replace(/e([-+]?)(\d+)/, (_, sign, digits) => `e${sign === "-" ? "−" : ""}${digits}`);

  // Format to three digits, with an exponent only where it is customary.
  function number(value, digits = 3) {
    if (value === null || value === undefined) return "–";
    const size = Math.abs(value);
    if (size !== 0 && (size < 1e-3 || size >= 1e6)) return power(value.toExponential(Math.max(0, digits - 2)));
    if (size >= 1000) return Math.round(value).toLocaleString("en").replaceAll(",", " ");
    return String(Number(value.toPrecision(digits))).replace("-", "−");
  }
  const count = value => (value ?? 0).toLocaleString("en").replaceAll(",", " ");
  const percent = value => (value === null || value === undefined ? "–" : value !== 0 && Math.abs(value) < 1e-5 ? "≈ 0 %" : `${number(100 * value)} %`);
  const fixed = value => (value === null || value === undefined ? "–" : value === 0 ? "0" : power(value.toExponential(1)));
  const many = (n, one, more = `${one}s`) => `${count(n)} ${n === 1 ? one : more}`;
  function duration(seconds) {
    if (seconds < 90) return `${number(seconds)} s`;
    return seconds < 5400 ? `${Math.round(seconds / 60)} min` : `${number(seconds / 3600)} h`;
  }
  const time = seconds => (seconds >= 1 || !seconds ? (seconds === null || seconds === undefined ? "–" : duration(seconds)) : seconds >= 1e-3 ? `${number(1e3 * seconds)} ms` : `${number(1e6 * seconds)} µs`);
  const day = text => (text || "").slice(0, 10);
  const step = dt => {
    const whole = Math.round(1 / dt);
    return Math.abs(whole * dt - 1) < 1e-4 ? `1/${whole} s` : `${number(1e3 * dt)} ms`;
  };

  const commit = text => (text || "unknown").slice(0, 10) + (/dirty/.test(text) ? "-dirty" : "");
  // List the machines and code versions of results: each pair once, in the order of the results.
  function madeBy(some, most = 2) {
    const origins = [...new Set(some.map(one => `${one.cpu || "unknown processor"}${one.machine_id ? ` (machine ${one.machine_id.slice(0, 6)})` : ""}, code ${commit(one.commit)}`))];
    const machines = new Set(some.map(one => one.machine_id || one.cpu)).size;
    const compare = machines > 1 ? ` · ${machines} machines: compare times within one, ratios of such times across them` : "";
    return `made on ${origins.slice(0, most).join("; on ")}${origins.length > most ? `; and by ${origins.length - most} more` : ""}${compare}`;
  }

  // Adjust a solver's colour for contrast with the page: lighter on dark, darker on light if it is pale.
  function colour(hex) {
    const parts = [1, 3, 5].map(k => parseInt(hex.slice(k, k + 2), 16));
    const light = (0.2126 * parts[0] + 0.7152 * parts[1] + 0.0722 * parts[2]) / 255;
    const by = isDark() ? Math.max(0, 0.5 - light) : -Math.max(0, light - 0.66);
    const end = by > 0 ? 255 : 0;
    return `#${parts.map(p => Math.round(p + (end - p) * Math.abs(by)).toString(16).padStart(2, "0")).join("")}`;
  }

  // The markers of the plots, as paths in a box from -8 to 8.
  const ring = (n, inner = 1, turn = 0) => {
    const points = [], steps = inner === 1 ? n : 2 * n;
    for (let k = 0; k < steps; k++) {
      const r = 6.5 * (inner !== 1 && k % 2 ? inner : 1), a = 2 * Math.PI * k / steps - Math.PI / 2 + turn;
      points.push(`${(r * Math.cos(a)).toFixed(2)} ${(r * Math.sin(a)).toFixed(2)}`);
    }
    return `M${points.join("L")}Z`;
  };
  const SHAPES = {
    none: "M-7-1.2h14v2.4h-14Z",
    circle: "M-5.5 0a5.5 5.5 0 1 0 11 0a5.5 5.5 0 1 0 -11 0Z", square: "M-5-5h10v10h-10Z", diamond: ring(4),
    "diamond-tall": "M0-7L4 0L0 7L-4 0Z", "triangle-up": "M0-6L6 5H-6Z", "triangle-down": "M0 6L6-5H-6Z",
    "triangle-left": "M-6 0L5-6V6Z", "triangle-right": "M6 0L-5-6V6Z", pentagon: ring(5), hexagon: ring(6),
    hexagon2: ring(6, 1, Math.PI / 6), octagon: ring(8, 1, Math.PI / 8), star: ring(5, 0.4),
    cross: "M-2-6h4v4h4v4h-4v4h-4v-4h-4v-4h4Z", x: "M-6-3l3-3l3 3l3-3l3 3l-3 3l3 3l-3 3l-3-3l-3 3l-3-3l3-3Z",
    "star-diamond": ring(4, 0.4), hexagram: ring(6, 0.58), "star-triangle-up": ring(3, 0.4),
    "star-square": ring(8, 0.55), "star-triangle-down": ring(3, 0.4, Math.PI),
    "triangle-ne": "M-5-5H5V5Z", "triangle-nw": "M5-5H-5V5Z", "triangle-se": "M-5 5H5V-5Z", "triangle-sw": "M5 5H-5V-5Z", hourglass: "M-5-6H5L-5 6H5Z", bowtie: "M-6-5L6 5V-5L-6 5Z", "diamond-wide": "M-7 0L0-4L7 0L0 4Z",
    arrow: "M0-6.5L5.5 5L0 1.5L-5.5 5Z",
    "arrow-bar-up": "M-6-6.5H6V-4H1.3L6 6H-6L-1.3-4H-6Z", "arrow-bar-down": "M-6 6.5H6V4H1.3L6-6H-6L-1.3 4H-6Z",
    "arrow-wide": "M-6.5 4.5L0-1L6.5 4.5V0L0-5.5L-6.5 0Z",
    "arrow-right": "M6.5 0L-6.5 3.5V-3.5Z",
    "arrow-left": "M-6.5 0L6.5 3.5V-3.5Z",
    "arrow-down": "M0 6.5L3.5-6.5H-3.5Z", "arrow-up": "M0-6.5L3.5 6.5H-3.5Z",
  };
  function glyph(mark) {
    const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
    svg.setAttribute("viewBox", "-8 -8 16 16");
    svg.setAttribute("class", "glyph");
    svg.setAttribute("aria-hidden", "true");
    path.setAttribute("d", own(SHAPES, mark?.symbol) || SHAPES.circle);
    path.style.fill = colour(mark?.color || "#858585");
    svg.append(path);
    return svg;
  }

  // A word for how a run ended, with a symbol in addition to the colour.
  const SIGNS = { ok: "✓", right: "✓", unsupported: "–", refused: "–", "not converged": "…" };
  function state(words, plain = "") {
    const kind = words === "ok" || words === "right" ? "good" : own(SIGNS, words) ? "mild" : "bad";
    return element(`span.state.${kind}`, {}, element("span", { "aria-hidden": "true" }, `${own(SIGNS, words) || "×"} `), plain || words);
  }

  return { commit, madeBy, number, count, percent, fixed, many, duration, time, day, step, colour, glyph, state };
})());
