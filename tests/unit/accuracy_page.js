// Runs the script of an accuracy page without a browser: node accuracy_page.js PAGE OUT. All choices are made once, and
// one mark is clicked; OUT gets the figures that Plotly was given, a hover text, and what the card says.
"use strict";
const fs = require("fs");

class Element {
  constructor(tag) { Object.assign(this, { tag, children: [], style: {}, listeners: {}, textContent: "" }); }
  get value() { return this.chosen ?? this.children[0].textContent; }
  set value(text) { this.chosen = text; }
  append(...children) { this.children.push(...children); }
  replaceChildren() { this.children = []; }
  addEventListener(name, listener) { this.listeners[name] = listener; }
  on(name, listener) { this.listeners[name] = listener; }
  removeAllListeners(name) { delete this.listeners[name]; }
  all(tag) { return this.children.flatMap(child => [...(child.tag === tag ? [child] : []), ...child.all(tag)]); }
  words() { return [this.textContent, ...this.children.map(child => child.words())].join(" "); }
}

const page = fs.readFileSync(process.argv[2], "utf8");
const data = new Element("script"), card = new Element("div"), main = new Element("main"), figures = [];
data.textContent = page.match(/id="data">([\s\S]*?)<\/script>/)[1];
global.document = {
  getElementById: id => ({ data, card })[id], querySelector: () => main, createElement: tag => new Element(tag),
};
let first;
global.Plotly = {
  react: (plot, data, layout) => { first ??= plot; figures.push({ data, layout }); return Promise.resolve(); },
};
new Function(page.slice(page.lastIndexOf("<script>") + "<script>".length, page.lastIndexOf("</script>")))();
for (const select of main.all("select")) {
  for (const option of select.children) {
    select.value = option.textContent;
    select.listeners.change();
  }
  select.value = select.children[0].textContent;
}
setTimeout(() => {
  const trace = figures[0].data[0];
  first.listeners.plotly_click({ points: [{ data: trace }] });
  fs.writeFileSync(process.argv[3], JSON.stringify({ figures, hover: trace.text[3], card: card.words() }));
}, 0);
