"use strict";
(() => {
  const source = document.getElementById("ledger");
  if (!source) return;  // nothing was proposed
  const data = JSON.parse(source.textContent);
  const body = document.getElementById("rows"), more = document.getElementById("more");
  const filter = document.getElementById("filter"), count = document.getElementById("count");
  const verdict = data.columns.indexOf("verdict"), page = 100;
  let rows = data.rows, shown = page, by = data.columns.indexOf("inliers"), down = true;
  const cell = (row, at) => {
    const td = document.createElement("td"), value = row[at];
    if (at === 0 && data.pictures.includes(value)) {
      const a = document.createElement("a");
      a.href = "#closure-" + value; a.textContent = value; td.append(a);
    } else if (at === verdict) {
      td.className = data.kept.includes(value) ? "accepted" : "rejected"; td.textContent = value;
    } else td.textContent = value === null ? "" : value;
    return td;
  };
  const draw = () => {
    body.replaceChildren(...rows.slice(0, shown).map((row) => {
      const tr = document.createElement("tr");
      tr.append(...row.map((_, at) => cell(row, at)));
      return tr;
    }));
    more.hidden = shown >= rows.length;
    count.textContent = Math.min(shown, rows.length) + " of " + rows.length + " shown";
  };
  const order = () => {
    const wanted = filter.value, sign = down ? -1 : 1;
    rows = data.rows.filter((row) => !wanted || row[verdict] === wanted);
    rows.sort((a, b) => {
      const x = a[by], y = b[by];
      if (x === y) return a[0] - b[0];
      if (x === null) return 1;  // what is not known comes last, either way
      if (y === null) return -1;
      return (x < y ? -1 : 1) * sign;
    });
    shown = page; draw();
  };
  document.querySelectorAll("#closures th button").forEach((button, at) => button.addEventListener("click", () => {
    down = by === at ? !down : at > verdict; by = at;
    document.querySelectorAll("#closures th").forEach((th, n) =>
      n === by ? th.setAttribute("aria-sort", down ? "descending" : "ascending") : th.removeAttribute("aria-sort"));
    order();
  }));
  filter.addEventListener("change", order);
  more.addEventListener("click", () => { shown += page; draw(); });
  order();
})();
