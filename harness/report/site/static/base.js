// What all views share: data that come as scripts, the selection in the URL, and elements.
"use strict";
window.springbench = (() => {
  const given = new Map(), waiting = new Map();

  // Called by every script of data.
  function give(name, value) { given.set(name, value); }

  // A script of this page's folder, loaded once: fulfilled when it has run.
  function script(path) {
    if (!waiting.has(path)) {
      waiting.set(path, new Promise((done, failed) => {
        const made = document.createElement("script");
        made.src = path;
        made.onload = () => done();
        made.onerror = () => { waiting.delete(path); failed(new Error(`${path} is not there; run springbench report again`)); };
        document.head.append(made);
      }));
    }
    return waiting.get(path);
  }

  // The data of a name, such as quickstart/runs.
  async function data(name) {
    if (!given.has(name)) await script(`site/data/${name.split("/").map(encodeURIComponent).join("/")}.js`);
    return given.get(name);
  }

  // The address of a file below a folder of the page, of the folder's escaped address `up` and a plain path; nothing
  // where it would lead out of the page's own scheme, as a folder called "javascript:..." might.
  function link(up, path) {
    const made = up + path.split("/").map(encodeURIComponent).join("/");
    return new URL(made, document.baseURI).protocol === location.protocol ? made : "";
  }

  // What an object of data holds under a name; nothing for names that every object has, such as "constructor".
  const own = (object, name) => (object && Object.hasOwn(object, name) ? object[name] : undefined);

  // The selection: a view and its parameters, both in the fragment of the URL.
  function where() {
    const [view, query = ""] = location.hash.slice(1).split("?");
    return { view: view || "overview", query: new URLSearchParams(query) };
  }
  function address(view, query) {
    const words = new URLSearchParams(Object.entries(query).filter(([, value]) => value !== "" && value != null)).toString();
    return `#${view}${words ? `?${words}` : ""}`;
  }
  // Change parameters of this view; step: as one of its own in the browser's history.
  let kept = {}, soon;
  function change(changes, step = false) {
    const { view, query } = where();
    const next = address(view, { ...Object.fromEntries(query), ...kept, ...changes });
    kept = {};
    if (next === location.hash) return;
    if (step) location.hash = next;
    else location.replace(next);
  }

  // Parameters of what is shown already, such as how a mesh is turned: nothing is drawn anew, and browsers take few of
  // these changes a second.
  function keep(changes) {
    const from = where().view;
    Object.assign(kept, changes);
    clearTimeout(soon);
    soon = setTimeout(() => {
      const { view, query } = where(), next = address(view, { ...Object.fromEntries(query), ...kept });
      kept = {};
      if (view !== from || next === location.hash) return;
      history.replaceState(null, "", next);
      if (document.documentElement.dataset.ready) document.documentElement.dataset.ready = next;
    }, 200);
  }

  // An element: element("a.link", {href: "#"}, "words", child...); properties that begin with "on" are listeners.
  function element(kind, properties = {}, ...children) {
    const [tag, ...classes] = kind.split(".");
    const made = document.createElement(tag);
    if (classes.length) made.className = classes.join(" ");
    for (const [key, value] of Object.entries(properties)) {
      if (value === undefined || value === null || value === false) continue;
      if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
      else if (key === "style" || key.includes("-") || key === "role" || key === "for") made.setAttribute(key, value);
      else made[key] = value;
    }
    return put(made, ...children);
  }
  // Append what there is: nothing of null, undefined, false, 0 and empty words.
  function put(parent, ...children) {
    parent.append(...children.filter(Boolean));
    return parent;
  }

  // A remark that screen readers hear, and that goes by itself.
  let until;
  function tell(words) {
    const box = document.getElementById("status");
    box.textContent = words;
    box.classList.remove("hidden");
    clearTimeout(until);
    until = setTimeout(() => box.classList.add("hidden"), 2500);
  }

  async function copy(words) {
    try {
      await navigator.clipboard.writeText(words);
    } catch {  // a page from the file system may not be allowed to
      const box = element("textarea", { value: words });
      document.body.append(box);
      box.select();
      document.execCommand("copy");
      box.remove();
    }
    tell("copied");
  }

  function save(name, words, type) {
    const link = element("a", { href: URL.createObjectURL(new Blob([words], { type })), download: name });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }

  const isDark = () => {
    const chosen = document.documentElement.dataset.theme;
    return chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  };

  return { give, script, data, link, own, where, address, change, keep, element, put, tell, copy, save, isDark, views: {} };
})();
