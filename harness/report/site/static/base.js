// Shared by all views: data loaded as scripts, the selection in the URL, and DOM elements.
"use strict";
window.springbench = (() => {
  const given = new Map(), waiting = new Map();

  // Called by every data script.
  function setData(name, value) { given.set(name, value); }

  // Load a script of this page's folder once; the promise is fulfilled when it has run.
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

  // Load the data with a name, such as quickstart/runs.
  async function data(name) {
    if (!given.has(name)) await script(`site/data/${name.split("/").map(encodeURIComponent).join("/")}.js`);
    return given.get(name);
  }

  // Return the URL of a file below a folder of the page, from the folder's escaped URL `up` and a plain path. Return
  // "" if it would leave the page's scheme, as for a folder called "javascript:...".
  function link(up, path) {
    const made = up + path.split("/").map(encodeURIComponent).join("/");
    return new URL(made, document.baseURI).protocol === location.protocol ? made : "";
  }

  // Look up a name in a data object; ignore names that every object has, such as "constructor".
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
  // Change parameters of this view; step: whether to add an entry to the browser's history.
  let pending = {}, soon;
  function change(changes, step = false) {
    const { view, query } = where();
    const next = address(view, { ...Object.fromEntries(query), ...pending, ...changes });
    pending = {};
    if (next === location.hash) return;
    if (step) location.hash = next;
    else location.replace(next);
  }

  // Update parameters of the current display, such as the rotation of a mesh: nothing is redrawn. Updates are throttled,
  // because browsers limit their rate.
  function replaceLater(changes) {
    const from = where().view;
    Object.assign(pending, changes);
    clearTimeout(soon);
    soon = setTimeout(() => {
      const { view, query } = where(), next = address(view, { ...Object.fromEntries(query), ...pending });
      pending = {};
      if (view !== from || next === location.hash) return;
      history.replaceState(null, "", next);
      if (document.documentElement.dataset.ready) document.documentElement.dataset.ready = next;
    }, 200);
  }

  // Create an element: element("a.link", {href: "#"}, "words", child...); properties that begin with "on" are listeners.
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
  // Append children; null, undefined, false, 0 and empty strings are skipped.
  function put(parent, ...children) {
    parent.append(...children.filter(Boolean));
    return parent;
  }

  // Show a message that screen readers announce, and that disappears by itself.
  let until;
  function announce(words) {
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
    announce("copied");
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

  return { setData, script, data, link, own, where, address, change, replaceLater, element, put, announce, copy, save, isDark, views: {} };
})();
