// Meshes on a canvas, rotated by dragging or by arrow keys, coloured by a number at each vertex; and iterates of solves.
"use strict";
Object.assign(springbench, (() => {
  const { element, put, data, link, own, number, replaceLater, where } = springbench;
  // From near to far: a colour map that is readable in grey as well (viridis).
  const RAMP = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
  const ramp = t => {
    const s = Math.max(0, Math.min(1, Number.isFinite(t) ? t : 0)) * (RAMP.length - 1), k = Math.min(RAMP.length - 2, Math.floor(s)), f = s - k;
    return RAMP[k].map((v, c) => Math.round(v + f * (RAMP[k + 1][c] - v)));
  };
  const rampCss = `linear-gradient(90deg, ${RAMP.map(c => `rgb(${c})`).join(", ")})`;

  const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer;
  const floats = text => new Float32Array(bytes(text)), whole = text => new Uint32Array(bytes(text));

  // Initial view of a mesh: along the direction in which it is thinnest, shared by meshes side by side.
  function camera(points) {
    const low = [1e30, 1e30, 1e30], high = [-1e30, -1e30, -1e30];
    for (let i = 0; i < points.length; i++) { low[i % 3] = Math.min(low[i % 3], points[i]); high[i % 3] = Math.max(high[i % 3], points[i]); }
    const middle = low.map((v, c) => (v + high[c]) / 2), size = low.map((v, c) => high[c] - v), radius = Math.hypot(...size) / 2 || 1;
    const turned = (where().query.get("turn") || "").split(",").map(Number), isStored = turned.length === 2 && turned.every(Number.isFinite);
    const [turn, tilt] = isStored ? turned : [size[1] <= size[0] ? -0.45 : 0.9, 0.35];
    return { middle, radius, turn, tilt, seen: new Set() };
  }

  function mesh(view, { springs, triangles }, label) {
    const canvas = element("canvas", { tabIndex: 0, role: "img", "aria-label": `${label}. Arrow keys turn it.` });
    let points = null, values = null, from = null;

    function paint() {
      const ratio = devicePixelRatio || 1, wide = canvas.clientWidth * ratio, high = canvas.clientHeight * ratio;
      if (!points || !wide) return;
      canvas.width = wide;
      canvas.height = high;
      const ink = canvas.getContext("2d"), n = points.length / 3, flat = new Float32Array(points.length), scale = 0.47 * Math.min(wide, 1.25 * high) / view.radius;
      const [c, s, ct, st] = [Math.cos(view.turn), Math.sin(view.turn), Math.cos(view.tilt), Math.sin(view.tilt)];
      for (let i = 0; i < n; i++) {
        const x = points[3 * i] - view.middle[0], y = points[3 * i + 1] - view.middle[1], z = points[3 * i + 2] - view.middle[2];
        const across = c * x + s * y, deep = -s * x + c * y;
        flat[3 * i] = wide / 2 + scale * across;
        flat[3 * i + 1] = high / 2 - scale * (ct * z + st * deep);
        flat[3 * i + 2] = ct * deep - st * z;
      }
      // Without values faces are grey between darker lines; otherwise a triangle mesh would be one dark patch.
      const style = getComputedStyle(canvas), [line, edge, face] = ["--ink", "--muted", "--rule"].map(name => style.getPropertyValue(name));
      const of = (...ids) => (values ? `rgb(${ramp(ids.reduce((sum, i) => sum + values[i], 0) / ids.length)})` : line);
      ink.lineWidth = ratio * (triangles.length ? 0.7 : 1.6);
      if (triangles.length) {
        const count = triangles.length / 3, order = Array.from({ length: count }, (_, k) => k);
        const depth = order.map(k => flat[3 * triangles[3 * k] + 2] + flat[3 * triangles[3 * k + 1] + 2] + flat[3 * triangles[3 * k + 2] + 2]);
        order.sort((a, b) => depth[b] - depth[a]);
        for (const k of order) {
          const ids = [triangles[3 * k], triangles[3 * k + 1], triangles[3 * k + 2]];
          ink.fillStyle = values ? of(...ids) : face;
          ink.strokeStyle = values ? ink.fillStyle : edge;
          ink.beginPath();
          ids.forEach((i, j) => (j ? ink.lineTo(flat[3 * i], flat[3 * i + 1]) : ink.moveTo(flat[3 * i], flat[3 * i + 1])));
          ink.closePath();
          ink.fill();
          ink.stroke();
        }
        return;
      }
      for (let k = 0; k < springs.length; k += 2) {
        const [i, j] = [springs[k], springs[k + 1]];
        ink.strokeStyle = of(i, j);
        ink.beginPath();
        ink.moveTo(flat[3 * i], flat[3 * i + 1]);
        ink.lineTo(flat[3 * j], flat[3 * j + 1]);
        ink.stroke();
      }
    }
    const turn = (across, up) => { view.turn += across; view.tilt = Math.max(-1.5, Math.min(1.5, view.tilt + up)); for (const one of view.seen) one(); replaceLater({ turn: `${view.turn.toFixed(2)},${view.tilt.toFixed(2)}` }); };
    view.seen.add(paint);
    canvas.onpointerdown = event => { from = [event.clientX, event.clientY]; canvas.setPointerCapture(event.pointerId); };
    canvas.onpointermove = event => {
      if (!from || !event.buttons) return;
      turn((event.clientX - from[0]) / 150, (event.clientY - from[1]) / 150);
      from = [event.clientX, event.clientY];
    };
    canvas.onkeydown = event => {
      const by = { ArrowLeft: [-0.15, 0], ArrowRight: [0.15, 0], ArrowUp: [0, -0.15], ArrowDown: [0, 0.15] }[event.key];
      if (by) { turn(...by); event.preventDefault(); }
    };
    new ResizeObserver(paint).observe(canvas);
    return { canvas, show(p, v = null) { points = p; values = v; paint(); } };
  }

  const scaleBox = (low, high) => element("div", {}, element("div.ramp", { style: `background: ${rampCss}` }), element("div.scale", {}, element("span", {}, low), element("span", {}, high)));

  // Details of a point of an accuracy plot: its solve, the iterate and the reference, and the command that repeats it.
  async function solve(box, sweep, chart, item, k, close) {
    const shut = element("button.quiet.close", { type: "button", onclick: close, "aria-label": "Close" }, "×");
    box.onkeydown = event => { if (event.key === "Escape" && event.target.tagName !== "INPUT") close(); };
    const figures = springbench.definitions(chart.hover.map(([column, words, format]) => [words, Array.isArray(item[column]) ? item[column][k] : item[column], format])
      .map(([words, value, format]) => [words, typeof value === "number" ? springbench.chart.figure(value, format) : value]));
    const made = item.provenance?.[k] || sweep.provenance[0] || {}, command = chart.command.replace("CONFIG", springbench.quoted(sweep.config || "CONFIG.yaml"));
    const settings = Object.entries(JSON.parse(item.parameters || "{}")).map(pair => pair.join(" ")).join(", ");
    const scrub = element("div"), file = item.recording_path && link(sweep.relative_url, item.recording_path), replay = own(sweep.replays, item.recording_path);
    put(box, shut, element("h2", {}, springbench.glyph(own(chart.styles, item.label)), ` ${item.label}`), element("p.label", {}, item.description),
      settings && element("p.muted", {}, settings), scrub,
      element("div.cols", {},
        element("div", {}, element("h3", {}, "At this point"), figures),
        element("div", {}, element("h3", {}, "Repeat"), springbench.commandBox(command, "Command that repeats the measurement"),
          springbench.method(own(chart.citations, item.label)),
          file && element("h3", {}, `Recording of ${item.label}'s solve`), file && springbench.replayBox(item.recording_path, file, replay && link("site/data/", `${sweep.slug}/${replay}.js`), `${item.label}: ${item.description}`),
          element("p.muted", {}, `Made by code ${springbench.commit(made.commit)} on ${made.cpu || "an unknown machine"}${sweep.provenance.length > 1 && !item.provenance ? `, and by ${sweep.provenance.length - 1} more (see the overview)` : ""}.`)),
        item.mesh_picture && element("figure", {}, element("a", { href: link(sweep.relative_url, item.mesh_picture.path) }, element("img", { src: link(sweep.relative_url, item.mesh_picture.path), alt: `The step's mesh, by ${item.mesh_picture.reference_label}` })),
          element("figcaption", {}, `Not this point: the mesh where ${item.mesh_picture.reference_label} was nearest to the minimum of this step.`))));
    await scrubber(scrub, sweep, item, k);
  }

  // The mesh of the iterate next to the reference's, coloured by distance, and a slider over the iterates.
  async function scrubber(box, sweep, item, k) {
    const name = own(sweep.solves, item.recording_path), at = item.iteration?.[k];
    if (!name) {
      if (item.recording_path) box.append(element("p.muted", {}, "The meshes of its iterates are not in this page: ", element("code", {}, "springbench report"), " takes them from the recordings."));
      return;
    }
    const found = await data(`${sweep.slug}/${name}`), all = floats(found.positions), best = floats(found.reference.positions), n = best.length / 3;
    const view = camera(best), shape = { springs: whole(found.springs), triangles: whole(found.triangles) };
    const left = mesh(view, shape, `Mesh of an iterate of ${item.label}`), right = mesh(view, shape, `Mesh of the reference, by ${found.reference.reference_label}`);
    const low = Math.log10(found.min_distance), high = Math.log10(found.max_distance), words = element("p", { role: "status" });
    const slider = element("input", { type: "range", min: 0, max: found.iterations.length - 1, step: 1, "aria-label": "Iteration" });
    const show = () => {
      const j = Number(slider.value), p = all.subarray(3 * n * j, 3 * n * (j + 1)), values = new Float32Array(n);
      let most = 0;
      for (let i = 0; i < n; i++) {
        const far = Math.hypot(p[3 * i] - best[3 * i], p[3 * i + 1] - best[3 * i + 1], p[3 * i + 2] - best[3 * i + 2]);
        most = Math.max(most, far);
        values[i] = (Math.log10(Math.max(far, 1e-30)) - low) / (high - low || 1);
      }
      left.show(p, values);
      words.textContent = `${item.label}, iteration ${found.iterations[j]}: the vertex furthest away is ${number(most)} m from the reference.`;
      slider.setAttribute("aria-valuetext", `iteration ${found.iterations[j]}`);
    };
    slider.oninput = () => { show(); replaceLater({ at: found.iterations[Number(slider.value)] }); };
    const target = where().query.has("at") ? Number(where().query.get("at")) : at ?? found.iterations.at(-1);
    slider.value = found.iterations.reduce((b, v, j) => (Math.abs(v - target) < Math.abs(found.iterations[b] - target) ? j : b), 0);
    box.append(words, slider, element("div.scrub", {}, element("figure", {}, left.canvas, element("figcaption", {}, `the iterate of ${item.label}, by its distance from the reference`), scaleBox(`${number(found.min_distance)} m`, `${number(found.max_distance)} m or more`)),
      element("figure", {}, right.canvas, element("figcaption", {}, `the reference: the last iterate of ${found.reference.reference_label}, ${number(found.reference.distance)} m from the certified minimum`))));
    right.show(best);
    show();
  }

  return { mesh, camera, floats, whole, scaleBox, solve };
})());
