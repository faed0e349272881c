// Elements of the page. Text from the server goes through `textContent` alone.

const SVG = "http://www.w3.org/2000/svg";

/** Return a new element; `attributes` may hold `text` and, by `on...`, listeners. */
export function element(tag, attributes = {}, ...children) {
  return fill(document.createElement(tag), attributes, children);
}

/** The same, of SVG. */
export function drawing(tag, attributes = {}, ...children) {
  return fill(document.createElementNS(SVG, tag), attributes, children);
}

function fill(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (name === "text") node.textContent = value;
    else if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else node.setAttribute(name, value);
  }
  node.append(...children);
  return node;
}

/** Set a node's text only where it is another one: what has not changed is not announced, and stays selected. */
export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

const nodesOf = new WeakMap(); // parent -> Map of key -> node

/** Bring a parent's children to one for each item, in order; nodes stay, so that focus and scrolling do. */
export function keep(parent, items, keyOf, make, update = () => {}) {
  const before = nodesOf.get(parent) ?? new Map();
  const after = new Map();
  for (const item of items) {
    const key = keyOf(item);
    const node = before.get(key) ?? make(item);
    update(node, item);
    after.set(key, node);
  }
  for (const [key, node] of before) if (!after.has(key)) node.remove();
  let place = parent.firstChild;
  for (const node of after.values()) {
    if (node === place) place = place.nextSibling;
    else parent.insertBefore(node, place);
  }
  nodesOf.set(parent, after);
}

/** Return a table within a region that scrolls by itself, by keyboard as well; `columns` are its headings. */
export function table(caption, columns) {
  const body = element("tbody");
  const title = element("caption", { text: caption });
  const head = element("tr", {}, ...columns.map((column) => element("th", { scope: "col", text: column })));
  const whole = element("table", {}, title, element("thead", {}, head), body);
  const region = element("div", { class: "scroll", role: "region", tabindex: "0", "aria-label": caption }, whole);
  return { region, body };
}

/** Give cells of the tables in a node their columns' names, which a small screen shows beside them. */
export function labelCells(node) {
  for (const { tHead, tBodies } of node.querySelectorAll("table")) {
    for (const { cells } of tBodies[0].rows) {
      [...cells].forEach((cell, index) => cell.setAttribute("data-label", tHead.rows[0].cells[index].textContent));
    }
  }
}

/** Show facts as a list of terms; those without a text are left out. */
export function showFacts(list, facts) {
  keep(
    list,
    facts.filter(([, text]) => text),
    ([term]) => term,
    ([term]) => element("div", {}, element("dt", { text: term }), element("dd")),
    (node, [, text]) => setText(node.lastChild, text),
  );
}

/** Return text no longer than a page can show. */
export function clip(text, longest = 2000) {
  return text.length > longest ? `${text.slice(0, longest)} …` : text;
}

/** Return a number as people write it. */
export function number(value, digits = 4) {
  if (value === null || value === undefined || Number.isNaN(value)) return "–";
  if (!Number.isFinite(value)) return value > 0 ? "∞" : "−∞";
  return Number(value.toPrecision(digits)).toString().replace("-", "−");
}

/** Return a time since 1970 [s], or one in words, as local time. */
export function stamp(time) {
  const date = new Date(typeof time === "number" ? 1000 * time : time);
  return Number.isNaN(date.getTime()) ? String(time) : date.toLocaleString("sv"); // 2026-07-31 14:05:09
}
