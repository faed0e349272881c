// Charts: a figure with a legend, and an SVG with axes, a unit of which is a pixel.

import { drawing, element, number, setText, stamp } from "./dom.js";

const [LEFT, RIGHT, TOP, BOTTOM] = [38, 24, 8, 120]; // of the plot
const GAP_S = 30; // without a look a curve is broken
const STEPS_S = [15, 30, 60, 120, 300];

/**
 * Return a chart's figure, and a function that draws rows of [x, each curve's y or null] from and to an x, with ticks
 * of [x, text]. `empty` says what will appear. With a `top` the axis goes from 0 at least to it, else by powers of ten.
 */
export function chart(title, curves, empty, top) {
  const values = curves.map(() => element("span"));
  const keys = curves.map((name, at) => element("span", { class: `key curve-${at}`, text: `${name} ` }, values[at]));
  const heading = element("figcaption", {}, element("strong", { text: title }), ...keys);
  const svg = drawing("svg", { class: "chart", role: "img" });
  const note = element("p", { class: "note", text: empty });

  function draw(rows, from, to, ticks) {
    const known = rows.flatMap(([, ...all]) => all).filter((value) => value !== null && (top || value > 0));
    note.hidden = known.length > 0;
    svg.toggleAttribute("hidden", !note.hidden);
    values.forEach((node, at) => setText(node, number(rows.at(-1)[at + 1], 2)));
    if (!note.hidden) return;
    const right = (svg.clientWidth || 360) - RIGHT;
    const levels = top ? halves(Math.max(top, ...known)) : powers(Math.min(...known), Math.max(...known));
    const [low, high] = [levels[0], levels.at(-1)].map((level) => (top ? level : Math.log10(level)));
    const x = (at) => (LEFT + ((right - LEFT) * (at - from)) / (to - from)).toFixed(1);
    const y = (value) =>
      (BOTTOM - ((BOTTOM - TOP) * ((top ? value : Math.log10(value)) - low)) / (high - low)).toFixed(1);
    svg.setAttribute("viewBox", `0 0 ${right + RIGHT} 140`);
    svg.setAttribute("aria-label", heading.textContent);
    svg.replaceChildren(
      ...levels.map((level) => drawing("path", { class: "grid", d: `M${LEFT},${y(level)}H${right}` })),
      ...levels.map((level) => drawing("text", { class: "level", x: LEFT - 6, y: y(level), text: number(level) })),
      ...ticks.map(([at, text]) => drawing("text", { x: x(at), y: BOTTOM + 14, text })),
      ...curves.map((_, at) => drawing("path", { class: `curve curve-${at}`, d: pathOf(rows, at + 1, x, y) })),
    );
  }
  return { figure: element("figure", {}, heading, svg, note), draw };
}

function pathOf(rows, column, x, y) {
  let last = -Infinity;
  return rows.reduce((path, { 0: at, [column]: value }) => {
    if (value === null) return path;
    const [begin, end] = at - last < GAP_S ? ["L", ""] : ["M", "h0"];
    last = at;
    return `${path}${begin}${x(at)},${y(value)}${end}`;
  }, "");
}

function halves(most) {
  const power = 10 ** Math.floor(Math.log10(most));
  const high = power * [1, 2, 5, 10].find((step) => step * power >= most);
  return [0, high / 2, high];
}

function powers(least, most) {
  const first = Math.floor(Math.log10(least));
  const last = Math.max(first + 1, Math.ceil(Math.log10(most)));
  return Array.from({ length: last - first + 1 }, (_, at) => Number(`1e${first + at}`));
}

/** Return ticks of local time between two [s]. */
export function timeTicks(from, to) {
  const step = STEPS_S.find((each) => to - from <= 4 * each);
  const ticks = [];
  for (let at = Math.ceil(from / step) * step; at <= to; at += step) {
    ticks.push([at, stamp(at).slice(11, step < 60 ? 19 : 16)]);
  }
  return ticks;
}

/** Return a bar from the middle of an extent of both signs. */
export function bar(value, most) {
  const length = (50 * Math.min(Math.abs(value), most)) / most;
  const box = { x: `${value < 0 ? 50 - length : 50}%`, width: `${length}%`, height: "100%" };
  return drawing("svg", { class: "bar", "aria-hidden": "true" }, drawing("rect", box));
}
