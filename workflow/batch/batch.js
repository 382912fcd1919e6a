"use strict";
(() => {
  document.documentElement.classList.add("js");
  const table = document.getElementById("table"), body = table.querySelector("tbody.scenes");
  const form = document.querySelector(".filters"), found = form.querySelector("output");
  const rows = [...body.rows], heads = [...table.querySelectorAll("thead th")];
  const fields = ["name", "status", "verdict", "stage", "source"];
  let sorted = "";  // column, with a minus before it where the largest comes first; empty: the order of the batch table

  // What is shown stands in the address, so that a view can be sent to somebody: #status=failed&sort=-rgb_psnr
  const sort = sortable(table, body, (column, up) => {
    sorted = (up ? "" : "-") + heads[column].dataset.key;
    write();
  });
  const write = () => {
    const state = new URLSearchParams();
    for (const name of fields) if (form.elements[name].value.trim()) state.set(name, form.elements[name].value.trim());
    if (sorted) state.set("sort", sorted);
    history.replaceState(null, "", `#${state}`);
  };
  const filter = () => {
    const words = form.elements.name.value.trim().toLowerCase().split(/\s+/);
    const chosen = fields.slice(1).map((name) => [name, form.elements[name].value]);
    let left = 0;
    for (const row of rows) {
      const name = row.dataset.scene.toLowerCase();
      row.hidden = !words.every((word) => name.includes(word)) || chosen.some(([key, value]) => value && row.dataset[key] !== value);
      left += !row.hidden;
    }
    found.textContent = left === rows.length ? `${rows.length} scenes` : `${left} of ${rows.length} scenes`;
  };
  const unsorted = () => {
    for (const head of heads) head.removeAttribute("aria-sort");
    body.append(...rows);
  };
  const read = () => {
    const state = new URLSearchParams(location.hash.slice(1));
    for (const name of fields) {
      const field = form.elements[name], value = state.get(name) ?? "";
      field.value = field.options && ![...field.options].some((option) => option.value === value) ? "" : value;
    }
    sorted = state.get("sort") ?? "";
    const column = heads.findIndex((head) => head.dataset.key === sorted.replace(/^-/, ""));
    if (column >= 0) sort(column, !sorted.startsWith("-"));
    else unsorted();
    filter();
  };
  form.addEventListener("input", () => { filter(); write(); });
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("reset", (event) => {
    event.preventDefault();  // which would empty the fields only after this
    for (const name of fields) form.elements[name].value = "";
    sorted = "";
    unsorted();
    filter();
    write();
  });
  for (const link of document.querySelectorAll("a.state")) {
    link.addEventListener("click", () => setTimeout(() => document.getElementById("scenes").scrollIntoView()));
  }
  addEventListener("hashchange", read);
  read();
  let closed = [];  // closed parts are printed too
  addEventListener("beforeprint", () => { closed = [...document.querySelectorAll("details:not([open])")]; for (const part of closed) part.open = true; });
  addEventListener("afterprint", () => { for (const part of closed) part.open = false; });
})();
