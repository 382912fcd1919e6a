"use strict";
// Tables that sort by a click on their heads: numbers before words, nothing last, `data-sort` of a cell before its text. `sorted`
// is called with (column, upwards) after a click; the function that is returned sorts without one.
const sortable = (table, body, sorted = () => {}) => {
  const heads = [...table.querySelectorAll("thead th")];
  const key = (row, column) => {
    const cell = row.cells[column];
    const value = cell.dataset.sort ?? cell.textContent.trim().toLowerCase();
    if (value === "" || value === "–") return null;
    return Number.isFinite(Number(value)) ? Number(value) : value;
  };
  const order = (a, b) => {
    if (typeof a === typeof b) return typeof a === "number" ? a - b : a.localeCompare(b);
    return typeof a === "number" ? -1 : 1;
  };
  const sort = (column, up) => {
    for (const other of heads) other.removeAttribute("aria-sort");
    heads[column].setAttribute("aria-sort", up ? "ascending" : "descending");
    const rows = [...body.rows].map((row) => [key(row, column), row]);
    rows.sort(([a], [b]) => (a === null || b === null ? (a === null) - (b === null) : up ? order(a, b) : order(b, a)));
    body.append(...rows.map(([, row]) => row));
  };
  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const up = head.getAttribute("aria-sort") !== "ascending";
      sort(column, up);
      sorted(column, up);
    });
  });
  return sort;
};
