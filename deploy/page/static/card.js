// The card's Markdown as elements: headings, tables, code and paragraphs. Text stays text, markup in it as well.

export function element(tag, text = "", properties = {}) {
  return Object.assign(document.createElement(tag), { textContent: text }, properties);
}

export function cardElements(markdown) {
  const body = markdown.replace(/^---\n[^]*?\n---\n/, ""); // the hub's front matter
  return body.match(/^```[^]*?^```$|(?:^.+$\n?)+/gm).map(block => blockElement(block.trim()));
}

function blockElement(block) {
  const heading = /^(#+) (.*)$/.exec(block);
  if (heading) return element(`h${Math.min(6, heading[1].length + 1)}`, heading[2]);
  if (block.startsWith("```")) {
    const code = element("pre", "", { tabIndex: 0 }); // the keyboard scrolls it
    code.append(element("code", block.replace(/^```.*\n|\n```$/g, "")));
    return code;
  }
  return block.startsWith("|") ? table(block) : inline("p", block);
}

function table(block) {
  const rows = block.split("\n").map(line => line.slice(1, -1).split(/(?<!\\)\|/).map(cell => cell.trim().replaceAll("\\|", "|")));
  const made = element("table"), wide = element("div", "", { className: "wide", tabIndex: 0 });
  rows.filter((_, index) => index !== 1).forEach((cells, index) => {
    const row = element("tr");
    row.append(...cells.map(cell => inline(index ? "td" : "th", cell)));
    if (index || cells.some(Boolean)) made.append(row);
  });
  wide.append(made);
  return wide;
}

function inline(tag, text) {
  const made = element(tag);
  text.split(/`([^`]+)`/).forEach((part, index) => made.append(index % 2 ? element("code", part) : part));
  return made;
}
