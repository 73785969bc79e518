// Views, navigation between them, and the light or dark theme.
"use strict";
(() => {
  const { element, data, own, where, views, isDark } = springbench;
  const content = document.getElementById("content"), toggle = document.getElementById("theme");
  const names = [["overview", "Overview"], ["runs", "Runs"], ["plots", "Plots"]];
  let shown = null;

  function theme() {
    toggle.textContent = isDark() ? "Light" : "Dark";
    toggle.setAttribute("aria-label", `Show the page ${isDark() ? "light" : "dark"}`);
  }
  toggle.addEventListener("click", () => {
    const next = isDark() ? "light" : "dark";
    document.documentElement.dataset.theme = next;
    try { localStorage.setItem("springbench.theme", next); } catch { /* for this time only */ }
    theme();
    dispatchEvent(new Event("recolour"));
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { theme(); dispatchEvent(new Event("recolour")); });

  async function show() {
    const { view, query } = where(), address = location.hash, named = own(views, view) ? view : "overview";
    const index = await data("index");
    for (const link of document.querySelectorAll("#views a")) {
      if (link.hash.startsWith(`#${named === "compare" ? "runs" : named}`)) link.setAttribute("aria-current", "page");
      else link.removeAttribute("aria-current");
    }
    document.title = `${names.find(([id]) => id === named)?.[1] || "Comparison"} · ${index.title} · springbench`;
    if (shown?.name === named && shown.update) {
      await shown.update(query);
    } else {
      delete document.documentElement.dataset.ready;
      shown?.leave?.();
      shown = { name: named };
      document.body.dataset.view = named;
      content.replaceChildren();
      scrollTo(0, 0);
      Object.assign(shown, await views[named](content, query, index));
    }
    if (address === location.hash) document.documentElement.dataset.ready = address || "#";  // what is shown, once it is
  }

  async function guarded() {
    try {
      await show();
    } catch (error) {
      content.replaceChildren(element("section.page", {}, element("h1", {}, "This cannot be shown"), element("p", {}, error.message)));
      document.documentElement.dataset.ready = location.hash || "#";
    }
  }

  document.querySelector(".skip").addEventListener("click", event => { event.preventDefault(); content.focus(); });
  data("index").then(index => {
    document.getElementById("title").textContent = index.title;
    const some = names.filter(([id]) => id === "overview" || index.sweeps.some(s => (id === "runs" ? s.runs : s.plots.length)));
    document.getElementById("views").append(...some.map(([id, words]) => element("a", { href: `#${id}` }, words)));
    theme();
    addEventListener("hashchange", guarded);
    return guarded();
  });
})();
