"use strict";

// Tables are sorted by the buttons in their headers: numbers as numbers, names naturally, empty cells and dashes last.
const collator = new Intl.Collator("en", { numeric: true });

function sort(button) {
  const header = button.closest("th");
  const body = button.closest("table").tBodies[0];
  const direction = header.getAttribute("aria-sort") === "ascending" ? "descending" : "ascending";
  for (const cell of header.parentNode.children) cell.removeAttribute("aria-sort");
  header.setAttribute("aria-sort", direction);
  const rows = [...body.rows].map((row) => ({ row, text: row.cells[header.cellIndex].textContent.trim().replace(/^-$/, "") }));
  const numbers = rows.every(({ text }) => text === "" || !Number.isNaN(Number(text)));
  const sign = direction === "ascending" ? 1 : -1;
  rows.sort((first, second) => {
    if (first.text === "" || second.text === "") return (first.text === "") - (second.text === "");
    const order = numbers ? Number(first.text) - Number(second.text) : collator.compare(first.text, second.text);
    return sign * order;
  });
  body.append(...rows.map(({ row }) => row));
}

for (const button of document.querySelectorAll("table.sortable th button")) {
  button.addEventListener("click", () => sort(button));
}

// Pictures and predictions that pass every filter are shown.
const filters = [...document.querySelectorAll("[data-filter]")];
const kinds = { pictures: document.querySelectorAll(".picture"), predictions: document.querySelectorAll("tr[data-outcome]") };

function filter() {
  const counts = Object.entries(kinds).filter(([, items]) => items.length).map(([kind, items]) => {
    let shown = 0;
    for (const item of items) {
      item.hidden = filters.some(({ value, dataset }) => value !== "-1" && item.dataset[dataset.filter] !== value);
      shown += !item.hidden;
    }
    return `${shown} of ${items.length} ${kind}`;
  });
  document.getElementById("shown").textContent = counts.join(", ");
}

for (const select of filters) select.addEventListener("change", filter);
if (filters.length) filter();

// On a narrow screen a picture is small until a click.
for (const button of document.querySelectorAll(".picture button")) {
  button.addEventListener("click", () => button.setAttribute("aria-pressed", button.getAttribute("aria-pressed") === "false"));
}

// Charts have the colors of the page, which may change.
const charts = JSON.parse(document.getElementById("charts").textContent);
const dark = window.matchMedia("(prefers-color-scheme: dark)");
const theme = document.getElementById("theme");

function colors() {
  const style = getComputedStyle(document.documentElement);
  const [text, line, card] = ["--text", "--line", "--card"].map((name) => style.getPropertyValue(name).trim());
  const layout = { "font.color": text, "hoverlabel.bgcolor": card, "hoverlabel.font.color": text };
  for (const axis of ["xaxis", "yaxis"]) {
    layout[`${axis}.gridcolor`] = line;
    layout[`${axis}.linecolor`] = line;
  }
  return [{ "error_x.color": text }, layout];
}

function isDark() {
  return (document.documentElement.dataset.theme || (dark.matches ? "dark" : "light")) === "dark";
}

function paint() {
  theme.textContent = isDark() ? "Light" : "Dark";
  for (const { name } of charts) Plotly.update(`chart-${name}`, ...colors());
}

theme.hidden = false;
theme.addEventListener("click", () => {
  document.documentElement.dataset.theme = isDark() ? "light" : "dark";
  paint();
});
dark.addEventListener("change", paint);
const options = { responsive: true, displayModeBar: false };
const look = {
  paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", dragmode: false, barmode: "group",
  margin: { l: 56, r: 12, t: 12, b: 48 }, font: { family: "system-ui, sans-serif", size: 13 },
  legend: { orientation: "h", yanchor: "bottom", y: 1.02, x: 0 }, hoverlabel: { namelength: -1 },
};
const scales = {
  linear: {}, percent: { range: [-1, 101] }, share: { range: [0, 102] },
  log: { type: "log", tickvals: [...Array(6).keys()].flatMap((power) => [1, 2, 5].map((step) => step * 10 ** power)) },
};
const axis = (text, rest) => (
  { fixedrange: true, automargin: true, zeroline: false, ...rest, title: { text, font: { size: 13 } } }
);

// Colors on dark and light, and dashes, which tell curves apart without colors. All are compared with the first, in gray.
const palette = ["#0b84c6", "#e1701a", "#1a9e6f", "#c9559d", "#9a7bd0", "#b58900", "#d1495b", "#5f9ea0"];
const dashes = ["solid", "dash", "dot", "dashdot"];
const color = (place) => (place === 0 ? "#8a8f98" : palette[(place - 1) % palette.length]);
const dash = (place) => (place === 0 ? "solid" : dashes[Math.floor((place - 1) / palette.length) % dashes.length]);
// Plotly's labels understand some HTML.
const escaped = (text) => text.replaceAll("&", "&amp;").replaceAll("<", "&lt;").replaceAll(">", "&gt;");

function line([name, points], place) {
  return {
    type: "scatter", mode: "lines", hovertemplate: "%{x:.4g}: %{y:.1f} %", name: escaped(name),
    x: points.map(([x]) => x), y: points.map(([, y]) => y), line: { color: color(place), dash: dash(place), width: 2 },
  };
}

// A group has a color, a member a place on the axis; members of a single group have a color each.
function bar([name, members], place, groups) {
  const whiskers = {
    type: "data", symmetric: false, thickness: 1.2, width: 3,
    array: members.map(([, value, [, high]]) => high - value), arrayminus: members.map(([, value, [low]]) => value - low),
  };
  return {
    type: "bar", orientation: "h", hovertemplate: "%{y}: %{x:.1f} %", name: escaped(name), error_x: whiskers,
    x: members.map(([, value]) => value), y: members.map(([member]) => escaped(member)),
    marker: { color: groups.length === 1 ? members.map((_, number) => color(number)) : color(place) },
  };
}

const drawn = charts.map(({ name, scale, axes, data }) => {
  const isBars = scale === "share";
  const bars = isBars ? data.reduce((sum, [, members]) => sum + members.length, 0) : 0;
  const layout = {
    ...look, height: Math.max(380, 100 + 16 * bars, 44 * data.length), showlegend: data.length > 1,
    xaxis: axis(axes[0], scales[scale]),
    yaxis: axis(axes[1], isBars ? { type: "category", autorange: "reversed" } : { range: [-2, 102] }),
  };
  return Plotly.newPlot(`chart-${name}`, data.map(isBars ? bar : line), layout, options);
});
Promise.all(drawn).then(() => {
  paint();
  document.documentElement.dataset.ready = "";
});
