"use strict";
// Sorting: by a heading, or where cards have none by the choice above them. What is missing comes
// last either way, and no row leaves its part of the table.
for (const part of document.querySelectorAll(".sortable")) {
  const heads = [...part.querySelectorAll("thead th")];
  const choice = part.querySelector("select.sort");
  const show = part.querySelector("select.show");
  const falls = head =>
    "down" in (head.classList.contains("shown") ? show.selectedOptions[0] : head).dataset;
  const sort = (column, down) => {
    const key = row => {
      const cell = row.children[column];
      return (cell.querySelector("[data-value]:not([hidden])") ?? cell).dataset.value ?? "";
    };
    const compare = (a, b) => {
      const x = key(a), y = key(b);
      if (x === "" || y === "") return (x === "") - (y === "");
      return (down ? -1 : 1) * (column ? x - y : x.localeCompare(y));
    };
    for (const body of part.querySelectorAll("tbody"))
      body.append(...[...body.querySelectorAll("[data-policy]")].sort(compare));
    heads.forEach(head => head.removeAttribute("aria-sort"));
    heads[column].setAttribute("aria-sort", down ? "descending" : "ascending");
    choice.value = column;
  };
  heads.forEach((head, column) => head.querySelector("button").addEventListener("click", () => {
    const now = head.getAttribute("aria-sort");
    sort(column, now ? now === "ascending" : falls(head));
  }));
  choice.addEventListener("change", () => {
    const column = Number(choice.value);
    sort(column, falls(heads[column]));
  });

  // Showing another figure of a family's tasks; only success has a mean over them.
  show?.addEventListener("change", () => {
    for (const figure of part.querySelectorAll("[data-figure]"))
      figure.hidden = figure.dataset.figure !== show.value;
    part.classList.toggle("meanless", show.value !== "0");
    heads.forEach(head => head.removeAttribute("aria-sort"));
  });
}

// Searching: every word must stand in the name of a policy or of one of its tasks. What does not
// match leaves the whole page.
const search = document.getElementById("search");
const toggle = (part, stays) => part.classList.toggle("gone", !stays);
const anyLeft = part => part.querySelector("[data-policy]:not(.gone)") !== null;
const look = () => {
  const words = search.value.toLowerCase().split(/\s+/).filter(Boolean);
  const fits = (policy, task) => {
    const name = `${policy} ${task}`.toLowerCase();
    return words.every(word => name.includes(word));
  };
  for (const row of document.querySelectorAll("[data-tasks]")) {
    const tasks = row.dataset.tasks.trim().split(" ");
    toggle(row, tasks.some(task => fits(row.dataset.policy, task)));
  }
  const tasks = [...document.querySelectorAll("details.task")];
  for (const task of tasks) {
    for (const part of task.querySelectorAll("[data-policy]"))
      toggle(part, fits(part.dataset.policy, task.dataset.task));
    toggle(task, anyLeft(task.querySelector("tbody")));
    const card = document.querySelector(`.strip [data-task="${CSS.escape(task.dataset.task)}"]`);
    if (card) toggle(card, !task.classList.contains("gone"));
  }
  for (const family of document.querySelectorAll(".family"))
    toggle(family, anyLeft(family.querySelector("tbody")));
  for (const study of document.querySelectorAll(".study"))
    toggle(study, JSON.parse(study.dataset.policies).some(policy => fits(policy, study.dataset.task)));
  const count = parts =>
    `${parts.filter(part => !part.classList.contains("gone")).length} of ${parts.length}`;
  const rows = [...document.querySelectorAll("#all-families [data-policy]")];
  document.getElementById("found").textContent =
    words.length ? `${count(rows)} policies, ${count(tasks)} tasks` : "";
};
search.addEventListener("input", look);
look();

// Pointing at a policy, in a table or a legend, picks out its curves.
for (const task of document.querySelectorAll("details.task")) {
  const curves = [...task.querySelectorAll("g[data-policy]")];
  const pick = name => curves.forEach(
    curve => curve.classList.toggle("faint", name !== null && curve.dataset.policy !== name));
  for (const part of task.querySelectorAll("tbody tr[data-policy], .legend [data-policy]")) {
    for (const event of ["pointerenter", "focusin"])
      part.addEventListener(event, () => pick(part.dataset.policy));
    for (const event of ["pointerleave", "focusout"])
      part.addEventListener(event, () => pick(null));
  }
}

// Clips: each stands once at the end of the page, and becomes a picture where it comes into view.
const reel = JSON.parse(document.getElementById("reel").textContent);
const projector = new IntersectionObserver(seen => {
  for (const {target, isIntersecting} of seen) {
    if (!isIntersecting) continue;
    target.src = `data:image/avif;base64,${reel[target.dataset.clip]}`;
    projector.unobserve(target);
  }
}, {rootMargin: "200px"});
for (const clip of document.querySelectorAll("[data-clip]")) projector.observe(clip);

// Opening: a task's address is #<task>, an entry's #<task>/<policy>, so that they can be linked to.
const open = () => {
  for (const shown of document.querySelectorAll("dialog[open]")) shown.close();
  let name = "";
  try { name = decodeURIComponent(location.hash.slice(1)); } catch { /* no address of ours */ }
  const part = document.getElementById(name);
  if (part instanceof HTMLDialogElement) {
    part.showModal();
    part.scrollTop = 0;
  } else if (part instanceof HTMLDetailsElement) {
    part.open = true;
    part.scrollIntoView();
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
