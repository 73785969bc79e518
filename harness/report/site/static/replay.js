// Replay of recordings in the page, by Rerun's web viewer. The page calls
//
//   springbench.replay(runId, script, {title, file})
//
// script: URL of the recording as a script; title: heading above it; file: URL of the recording itself.
// The viewer, `viewer.js` next to this file, is loaded at the first call. Each script passes its content as
// `springbench.scriptContent`. The start of the viewer is undocumented: harness/report/site/rerun_viewer.py pins its version.
"use strict";
window.springbench ??= {};
(() => {
  const here = new URL(".", document.currentScript.src);
  const STYLE = `
.replay { inset: 0; width: 100vw; height: 100vh; height: 100dvh; max-width: none; max-height: none; margin: 0; padding: 0;
  border: 0; display: none; flex-direction: column; background: #15181c; color: #f1f1ee; overflow: hidden }
.replay[open] { display: flex }
.replay > header { display: flex; gap: 12px; align-items: center; padding: 6px 8px 6px 14px }
.replay h2 { font: 600 15px/1.3 system-ui, sans-serif; margin: 0; flex: 1; overflow-wrap: anywhere }
.replay button { font: 14px/1.2 system-ui, sans-serif; min-height: 32px; padding: 4px 12px; color: inherit;
  background: #343a42; border: 1px solid #8a929c; border-radius: 4px; cursor: pointer }
.replay :focus-visible { outline: 2px solid #7db7ff; outline-offset: 2px }
.replay .stage { position: relative; flex: 1; min-height: 0 }
@media (min-aspect-ratio: 1) { .replay .stage { max-height: calc(60vw + 57px) } } /* the mesh's view is not higher than wide */
.replay canvas { position: absolute; inset: 0; width: 100%; height: 100%; display: block }
.replay .said { position: absolute; inset: 0; margin: auto; width: min(44em, 90%); height: fit-content; text-align: center;
  font: 16px/1.5 system-ui, sans-serif }
.replay .said a { color: #9cc9ff }
.replay .said code { display: block; overflow-wrap: anywhere; background: #000; padding: 8px; margin: 8px 0; user-select: all }`;

  let dialog, running, turn = 0, loading = Promise.resolve();

  function element(name, parent, properties = {}) {
    const made = Object.assign(document.createElement(name), properties);
    parent.append(made);
    return made;
  }

  function opened(title) {
    if (!dialog) {
      element("style", document.head, { textContent: STYLE });
      dialog = element("dialog", document.body, { className: "replay" });
      const head = element("header", dialog);
      element("h2", head, { id: "replay-title" });
      element("button", head, { type: "button", textContent: "Close" }).addEventListener("click", () => dialog.close());
      element("div", dialog, { className: "stage" });
      dialog.setAttribute("aria-labelledby", "replay-title");
      dialog.addEventListener("close", () => dialog.open || stop()); // asynchronous: another may be open
    }
    dialog.querySelector("h2").textContent = title;
    dialog.querySelector(".stage").replaceChildren();
    if (!dialog.open) dialog.showModal();
  }

  function say(words, file) {
    const stage = dialog.querySelector(".stage");
    stage.querySelector(".said")?.remove();
    if (!words) return;
    const said = element("div", stage, { className: "said" });
    said.setAttribute("role", "status");
    element("p", said, { textContent: words });
    if (!file) return;
    const line = element("p", said);
    element("a", line, { href: file, textContent: "The recording as a file", download: "" });
    line.append(", and the command that opens it where springbench is installed:");
    element("code", said, { textContent: `springbench view ${path(file)}` });
  }

  function path(file) {
    const url = new URL(file, document.baseURI);
    const plain = decodeURIComponent(url.protocol === "file:" ? url.pathname : file);
    return /^[\w./~+-]+$/.test(plain) ? plain : `'${plain.replaceAll("'", "'\\''")}'`;
  }

  // The content of a script; one is loaded at a time. A page from the file system can load only scripts.
  function loadContent(source, problem) {
    const next = loading.then(() => new Promise((done, fail) => {
      const script = element("script", document.head, { src: source });
      script.onload = () => {
        const found = springbench.scriptContent;
        delete springbench.scriptContent;
        script.remove();
        found ? done(found) : fail(new Error(problem));
      };
      script.onerror = () => { script.remove(); fail(new Error(problem)); };
    }));
    loading = next.catch(() => {});
    return next;
  }

  async function unpacked(base64) {
    const text = atob(base64), packed = new Uint8Array(text.length);
    for (let k = 0; k < text.length; k++) packed[k] = text.charCodeAt(k);
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  }

  // A module that uses SIMD, as the viewer does; browsers before 2021 and 2023 (Safari) do not support it.
  const SIMD = [0, 97, 115, 109, 1, 0, 0, 0, 1, 5, 1, 96, 0, 1, 123, 3, 2, 1, 0, 10, 10, 1, 8, 0, 65, 0, 253, 15, 253, 98, 11];

  function lacking() {
    if (typeof DecompressionStream === "undefined") return "This browser cannot unpack the viewer; one from 2023 or later can.";
    if (typeof WebAssembly === "undefined" || !WebAssembly.validate(new Uint8Array(SIMD)))
      return "This browser runs no WebAssembly with SIMD, which the viewer is made of.";
    if (!document.createElement("canvas").getContext("webgl2"))
      return "This browser has no WebGL 2 here, by which the viewer draws.";
    return "";
  }

  // Time after which the viewer is shown in any case [ms].
  const OPENS = 20000;
  let ready;

  function viewer() {
    ready ??= (async () => {
      const brought = await loadContent(new URL("viewer.js", here).href, "The viewer is not part of this report: it was left out.");
      const wasm = await unpacked(brought.wasm);
      delete WebAssembly.instantiateStreaming; // it requires a server's response with a MIME type
      await brought.start({ module_or_path: wasm });
      return brought.start;
    })();
    ready.catch(() => { ready = undefined; });
    return ready;
  }

  async function start() {
    const { WebHandle } = await viewer();
    const canvas = element("canvas", dialog.querySelector(".stage"), { tabIndex: 0 });
    canvas.setAttribute("aria-label", "Rerun viewer: space plays, the mouse turns and moves what is seen");
    const dark = matchMedia("(prefers-color-scheme: dark)").matches;
    let opened = () => {};
    const seen = new Promise(done => { opened = done; });
    // Until the recording is open the viewer shows its own welcome screen, which is hidden.
    canvas.style.visibility = "hidden";
    const handle = new WebHandle({
      on_viewer_event: event => { if (JSON.parse(event).type === "recording_open") opened(); },
      url: [], render_backend: "webgl", hide_welcome_screen: true, enable_history: false, notebook: true, persist: false,
      theme: document.documentElement.dataset.theme || (dark ? "dark" : "light"),
      panel_state_overrides: { top: "Hidden" },
    });
    await handle.start(canvas);
    return { handle, canvas, seen };
  }

  function stop() {
    turn++;
    if (!running) return;
    const { handle, watch } = running;
    running = undefined;
    clearInterval(watch);
    handle.destroy();
    handle.free();
    dialog.querySelector(".stage").replaceChildren();
  }

  // Show a recording; resolves to whether it is visible, and states the reason if it is not.
  springbench.replay = async (runId, script, { title = runId, file = "" } = {}) => {
    stop();
    const mine = turn;
    opened(title);
    try {
      const lack = lacking();
      if (lack) throw new Error(lack);
      say("The viewer is loading, once for all recordings ...");
      const recording = await loadContent(
        new URL(script, document.baseURI).href,
        "This recording is not part of the report; `springbench report` writes those that are there.",
      );
      if (!title || title === runId) dialog.querySelector("h2").textContent = recording.title || runId;
      const rrd = await unpacked(recording.rrd);
      if (mine !== turn) return false;
      const { handle, canvas, seen } = await start();
      if (mine !== turn) { handle.destroy(); handle.free(); return false; }
      const watch = setInterval(() => {
        if (handle.has_panicked()) {
          clearInterval(watch);
          say(`The viewer has stopped: ${handle.panic_message()}`, file);
        }
      }, 1000);
      running = { handle, watch };
      handle.open_channel(runId, runId);
      handle.send_rrd_to_channel(runId, rrd);
      handle.close_channel(runId);
      await Promise.race([seen, new Promise(done => setTimeout(done, OPENS))]);
      if (mine !== turn) return false;
      canvas.style.visibility = "";
      say("");
      return true;
    } catch (error) {
      if (mine === turn) say(error instanceof Error ? error.message : `The viewer cannot start: ${error}`, file);
      return false;
    }
  };
})();
