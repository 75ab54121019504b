// Sorts tables of class "sortable" by a click on a head, and filters the one of class "filterable" by menus.
// A cell counts by its data-value, else by its text. Without this script all is readable in its first order.
"use strict";
(() => {
  const value = (row, index) => {
    const cell = row.cells[index];
    return cell ? (cell.dataset.value ?? cell.textContent.trim()) : "";
  };
  const number = (text) => parseFloat(text.replace(/^[<+▶ ]+/, "").replace("−", "-").replace(/,/g, ""));
  const compare = (a, b) => {
    const [x, y] = [number(a), number(b)];
    if (Number.isNaN(x) && Number.isNaN(y)) return a.localeCompare(b);
    return Number.isNaN(x) || Number.isNaN(y) ? Number.isNaN(x) - Number.isNaN(y) : x - y;
  };

  function sort(table, head, index) {
    const down = head.getAttribute("aria-sort") === "ascending";
    for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    for (const body of table.tBodies) {
      const rows = [...body.rows];
      const pinned = (row) => row.matches(".level, .mean, .strict");
      const last = rows.filter((row) => row.matches(".mean, .strict"));
      const sorted = rows.filter((row) => !pinned(row));
      sorted.sort((a, b) => compare(value(a, index), value(b, index)) * (down ? -1 : 1));
      body.append(...sorted, ...last);
    }
  }

  for (const table of document.querySelectorAll("table.sortable")) {
    [...table.tHead.rows[0].cells].forEach((head, index) => {
      const button = document.createElement("button");
      button.type = "button";
      button.append(...head.childNodes);
      button.addEventListener("click", () => sort(table, head, index));
      head.append(button);
    });
  }

  for (const table of document.querySelectorAll("table.filterable")) {
    const rows = [...table.tBodies[0].rows];
    const bar = document.createElement("form");
    const count = document.createElement("output");
    const menus = [];
    const update = () => {
      let shown = 0;
      for (const row of rows) {
        row.hidden = menus.some(([menu, index]) => menu.value !== "" && menu.value !== value(row, index));
        shown += !row.hidden;
      }
      count.textContent = `${shown} of ${rows.length} episodes`;
    };
    [...table.tHead.rows[0].cells].forEach((head, index) => {
      if (!("filter" in head.dataset)) return;
      const menu = document.createElement("select");
      const values = [...new Set(rows.map((row) => value(row, index)))].filter((text) => text !== "").sort(compare);
      menu.setAttribute("aria-label", head.textContent.trim());
      menu.append(new Option(`every ${head.textContent.trim()}`, ""), ...values.map((text) => new Option(text, text)));
      menu.addEventListener("change", update);
      menus.push([menu, index]);
      bar.append(menu);
    });
    bar.className = "filters";
    bar.append(count);
    table.closest(".scroll").before(bar);
    update();
  }

  // A link to something folded unfolds it.
  const unfold = () => {
    const target = document.getElementById(decodeURIComponent(location.hash.slice(1)));
    for (let at = target; at; at = at.parentElement) if (at.tagName === "DETAILS") at.open = true;
    if (target) target.scrollIntoView();
  };
  addEventListener("hashchange", unfold);
  if (location.hash) unfold();
})();
