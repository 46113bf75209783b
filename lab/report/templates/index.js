"use strict";
(() => {
  const table = document.getElementById("runs");
  if (!table) return;
  const body = table.tBodies[0], heads = [...table.tHead.rows[0].cells], rows = [...body.rows];
  const count = document.getElementById("shown"), search = document.getElementById("search");
  const text = (row) => [...row.cells].filter((c) => !c.classList.contains("curve")).map((c) => c.textContent).join(" ");
  const words = new Map(rows.map((row) => [row, text(row).toLowerCase()]));
  const key = (row, column) => { const cell = row.cells[column]; return cell.dataset.by ?? cell.textContent.trim(); };

  function sortBy(column, down) {
    const keys = new Map(rows.map((row) => [row, key(row, column)]));
    const numbers = new Map([...keys].map(([row, text]) => [row, /^[-+.\d]/.test(text) && !/\d-\d/.test(text) ? parseFloat(text) : NaN]));
    rows.sort((p, q) => {
      const a = keys.get(p), b = keys.get(q), x = numbers.get(p), y = numbers.get(q);
      if ((a === "") !== (b === "")) return a === "" ? 1 : -1; // empty cells last, whichever the order
      const less = isNaN(x) || isNaN(y) ? a.localeCompare(b, undefined, { numeric: true }) : x - y;
      return down ? -less : less;
    });
    body.append(...rows);
    for (const head of heads) head.removeAttribute("aria-sort");
    heads[column].setAttribute("aria-sort", down ? "descending" : "ascending");
  }
  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => sortBy(column, head.getAttribute("aria-sort") === "ascending"));
  });

  const filters = [...document.querySelectorAll("#filters button[data-verdict]")];
  function filter() {
    const verdicts = new Set(filters.filter((b) => b.getAttribute("aria-pressed") === "true").map((b) => b.dataset.verdict));
    const parts = search.value.toLowerCase().split(/\s+/).filter(Boolean);
    let shown = 0;
    for (const row of rows) {
      const match = (!verdicts.size || verdicts.has(row.dataset.verdict)) && parts.every((part) => words.get(row).includes(part));
      row.hidden = !match;
      shown += match;
    }
    count.textContent = shown === rows.length ? "" : `${shown} of ${rows.length} runs shown`;
    document.getElementById("clear").hidden = shown === rows.length && !parts.length && !verdicts.size;
    document.getElementById("none").hidden = shown > 0;
  }
  for (const button of filters) button.addEventListener("click", () => {
    button.setAttribute("aria-pressed", String(button.getAttribute("aria-pressed") !== "true"));
    filter();
  });
  search.addEventListener("input", filter);
  document.getElementById("clear").addEventListener("click", () => {
    search.value = "";
    for (const button of filters) button.setAttribute("aria-pressed", "false");
    filter();
    search.focus();
  });
  document.getElementById("filters").hidden = false;
  if (search.value) filter(); // the browser keeps the text when the page is loaded again
})();
