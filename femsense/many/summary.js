"use strict";
// The table of summary.html: sorted by a click on a column, filtered by words and by status.
(() => {
  const { columns, rows, links } = JSON.parse(document.getElementById("data").textContent);
  const place = document.getElementById("jobs");
  const STATUS = columns.indexOf("status"), FOLDER = columns.indexOf("folder");
  const shown = columns.map((_, i) => i).filter((i) => i !== FOLDER && rows.some((row) => row[i] !== null && row[i] !== ""));
  const numeric = columns.map((_, i) => rows.every((row) => row[i] === null || typeof row[i] === "number"));
  const make = (tag, properties = {}, ...children) => {
    const element = Object.assign(document.createElement(tag), properties);
    element.append(...children);
    return element;
  };
  const style = make("style", { textContent: `
    .bar { display: flex; flex-wrap: wrap; gap: 8px 14px; align-items: center; margin: 18px 0 4px; }
    .bar input, .bar select { font: inherit; padding: 5px 9px; border: 1px solid var(--line); border-radius: 6px; background: #fff; }
    .bar input { flex: 1 1 240px; max-width: 420px; }
    #jobs th button { all: unset; cursor: pointer; font-weight: 600; } #jobs th button:focus-visible { outline: 2px solid var(--accent); }
    #jobs tr.bad td:nth-child(2) { color: var(--warn); font-weight: 600; }
    #jobs td { max-width: 360px; } #jobs td.reason { min-width: 260px; } #jobs td:first-child { white-space: nowrap; }
    body:has(#jobs) :is(main, header, footer) { max-width: 1400px; }` });
  const words = make("input", { type: "search", placeholder: "words, or column>number such as largest_force_n>1", ariaLabel: "Filter" });
  const counts = new Map();
  for (const row of rows) counts.set(row[STATUS], (counts.get(row[STATUS]) || 0) + 1);
  const status = make("select", { ariaLabel: "Status" }, make("option", { value: "", textContent: `every status (${rows.length})` }),
    ...[...counts].map(([name, count]) => make("option", { value: name, textContent: `${name} (${count})` })));
  const found = make("span", { className: "soft" });
  const body = make("tbody");
  let by = -1, up = true;
  const number = (value) => value === null ? "" : Number.isInteger(value) ? String(value) : String(Number(value.toPrecision(4)));
  const tests = () => words.value.trim().split(/\s+/).filter(Boolean).map((word) => {
    const limit = /^(\w+)([<>=])(.+)$/.exec(word), column = limit ? columns.indexOf(limit[1]) : -1;
    if (column < 0) return (row) => row.some((cell) => String(cell ?? "").toLowerCase().includes(word.toLowerCase()));
    const value = Number(limit[3]);
    if (limit[2] === "=") return (row) => String(row[column]) === limit[3] || row[column] === value;
    return (row) => row[column] !== null && (limit[2] === ">" ? row[column] > value : row[column] < value);
  });
  const compare = (a, b) => {
    const [x, y] = [rows[a][by], rows[b][by]];
    if (x === null || y === null) return (x === null) - (y === null);  // empty cells stand last either way
    const order = numeric[by] ? x - y : String(x).localeCompare(String(y), undefined, { numeric: true });
    return up ? order : -order;
  };
  const draw = () => {
    const all = tests();
    const chosen = rows.map((_, i) => i).filter((i) => (!status.value || rows[i][STATUS] === status.value) && all.every((test) => test(rows[i])));
    if (by >= 0) chosen.sort(compare);
    body.replaceChildren(...chosen.map((i) => make("tr", { className: rows[i][STATUS] === "done" ? "" : "bad" },
      ...shown.map((j) => {
        const cell = rows[i][j], text = numeric[j] ? number(cell) : String(cell ?? "");
        return make("td", { className: numeric[j] ? "n" : columns[j] }, j === 0 && links[i] ? make("a", { href: encodeURI(links[i]), textContent: text }) : text);
      }))));
    found.textContent = `${chosen.length} of ${rows.length}`;
    headers.forEach((header, k) => header.setAttribute("aria-sort", shown[k] === by ? (up ? "ascending" : "descending") : "none"));
  };
  const headers = shown.map((j) => {
    const button = make("button", { textContent: columns[j], title: "sort by this column" });
    button.addEventListener("click", () => {
      [by, up] = by === j ? [j, !up] : [j, true];
      headers.forEach((header, k) => { header.firstChild.textContent = columns[shown[k]] + (shown[k] === by ? (up ? " ▲" : " ▼") : ""); });
      draw();
    });
    return make("th", { className: numeric[j] ? "n" : "", scope: "col" }, button);
  });
  words.addEventListener("input", draw);
  status.addEventListener("change", draw);
  place.append(style, make("div", { className: "bar" }, words, status, found),
    make("div", { className: "scroll dense", tabIndex: 0 }, make("table", {}, make("thead", {}, make("tr", {}, ...headers)), body)));
  draw();
})();
