"use strict";
// Sorting: by a heading, or on a phone by the choice above the cards.
for (const sheet of document.querySelectorAll(".sortable")) {
  const body = sheet.querySelector("tbody");
  const heads = [...sheet.querySelectorAll("thead th")];
  const choice = sheet.parentElement.querySelector("select");
  const sort = (column, down) => {
    const sign = down ? -1 : 1;
    const key = row => row.children[column].dataset.value;
    const compare = (a, b) => {
      const x = key(a), y = key(b);
      // What is missing comes last either way.
      if (x === "" || y === "") return (x === "") - (y === "");
      return sign * (column ? x - y : x.localeCompare(y));
    };
    body.append(...[...body.rows].sort(compare));
    heads.forEach(head => head.removeAttribute("aria-sort"));
    heads[column].setAttribute("aria-sort", down ? "descending" : "ascending");
    if (choice) choice.value = column;
  };
  heads.forEach((head, column) => head.querySelector("button").addEventListener("click", () => {
    const now = head.getAttribute("aria-sort");
    sort(column, now ? now === "ascending" : "down" in head.dataset);
  }));
  choice?.addEventListener("change", () => {
    const column = Number(choice.value);
    sort(column, "down" in heads[column].dataset);
  });
}

// Searching: every word must stand in the policy's name; what does not match leaves the whole page.
const search = document.getElementById("search");
const marked = [...document.querySelectorAll("[data-policy]")];
const policies = new Set(marked.map(part => part.dataset.policy));
const look = () => {
  const words = search.value.toLowerCase().split(/\s+/).filter(Boolean);
  const fits = name => words.every(word => name.toLowerCase().includes(word));
  for (const part of marked) part.classList.toggle("gone", !fits(part.dataset.policy));
  const n = [...policies].filter(fits).length;
  document.getElementById("found").textContent =
    words.length ? `${n} of ${policies.size} policies` : "";
};
search.addEventListener("input", look);
look();

// Pointing at a policy, in a table or a legend, picks out its curves.
for (const section of document.querySelectorAll("section")) {
  const curves = [...section.querySelectorAll("g[data-policy]")];
  const pick = name => curves.forEach(
    curve => curve.classList.toggle("faint", name !== null && curve.dataset.policy !== name));
  for (const part of section.querySelectorAll("tbody tr[data-policy], .legend [data-policy]")) {
    for (const event of ["pointerenter", "focusin"])
      part.addEventListener(event, () => pick(part.dataset.policy));
    for (const event of ["pointerleave", "focusout"])
      part.addEventListener(event, () => pick(null));
  }
}

// Opening: an entry's address is #<task>/<policy>, so that it can be linked to.
const open = () => {
  for (const shown of document.querySelectorAll("dialog[open]")) shown.close();
  let name = "";
  try { name = decodeURIComponent(location.hash.slice(1)); } catch { /* no address of ours */ }
  const sheet = document.getElementById(name);
  if (sheet instanceof HTMLDialogElement) {
    sheet.showModal();
    sheet.scrollTop = 0;
  }
};
for (const sheet of document.querySelectorAll("dialog")) {
  // Another address, without a jump to the top of the page.
  sheet.addEventListener("close", () => {
    if (location.hash && decodeURIComponent(location.hash.slice(1)) === sheet.id)
      history.replaceState(null, "", "#");
  });
  sheet.addEventListener("click", event => { if (event.target === sheet) sheet.close(); });
}
window.addEventListener("hashchange", open);
open();
