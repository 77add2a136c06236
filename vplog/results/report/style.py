"""The style and the script of the page, both inside it: nothing is fetched."""

STYLE = """
:root{color-scheme:light dark;--paper:#fff;--ink:#1b1f24;--quiet:#5c6670;--line:#d9dee3;--card:#f5f7f9;
--before:#8a8f96;--after:#1f6fd1;--yes:#1a8a3c;--no:#c9302c;--faint:#e2a09e;--truth:#b06a00;--gps:#9150c9}
@media (prefers-color-scheme:dark){:root{--paper:#14171a;--ink:#e6e9ec;--quiet:#9aa4ae;--line:#343b42;--card:#1d2226;
--before:#8b939b;--after:#63a9ff;--yes:#4cc870;--no:#ff6f66;--faint:#7d3f3d;--truth:#f0b04a;--gps:#c794f5}}
*{box-sizing:border-box}
body{margin:0 auto;padding:16px;max-width:1100px;background:var(--paper);color:var(--ink);
font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif;overflow-wrap:anywhere}
h1{font-size:1.5rem;margin:.2em 0}
h2{font-size:1.15rem;margin:2em 0 .5em;padding-bottom:.2em;border-bottom:1px solid var(--line)}
h3{font-size:1rem;margin:1.2em 0 .3em}p{margin:.4em 0}.quiet,figcaption{color:var(--quiet);font-size:.87rem}
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(130px,1fr));gap:8px;margin:12px 0}
.tile{background:var(--card);border:1px solid var(--line);border-radius:6px;padding:8px 10px}
.tile b{display:block;font-size:1.2rem}.tile span{color:var(--quiet);font-size:.82rem}
.box{overflow-x:auto;max-width:100%;border:1px solid var(--line);border-radius:6px}
#closures td:nth-child(2),#closures th:nth-child(2){text-align:left}.tall{max-height:75vh;overflow-y:auto}
table{border-collapse:collapse;width:100%;font-size:.85rem;font-variant-numeric:tabular-nums}
th,td{padding:3px 8px;text-align:right;white-space:nowrap;border-bottom:1px solid var(--line)}
th:first-child,td:first-child,.words{text-align:left}th{background:var(--card);position:sticky;top:0}
td.words{white-space:normal}
th button{font:inherit;font-weight:600;color:inherit;background:none;border:0;padding:0;cursor:pointer}
.pictures{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,440px),1fr));gap:14px}
.charts{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,420px),1fr));gap:10px 18px}
.small{grid-template-columns:repeat(auto-fill,minmax(150px,1fr))}
figure{margin:0}img{width:100%;height:auto;display:block;border-radius:4px;background:#181818}
svg{width:100%;height:auto;display:block}svg text{font-size:12px;fill:var(--quiet)}
svg path{fill:none}.edge{stroke-width:.8;opacity:.5}.edge.no{stroke-width:1.4;opacity:1}
.track{stroke-width:2;stroke-linejoin:round}.dot{stroke-width:5;stroke-linecap:round;opacity:.7}
.axis{stroke:var(--quiet);stroke-width:1}.bound{stroke:var(--ink);stroke-width:1.5;stroke-dasharray:4 3}
.before{stroke:var(--before);stroke-dasharray:6 4}.after{stroke:var(--after)}
.yes{stroke:var(--yes)}.no{stroke:var(--no)}
.truth{stroke:var(--truth);stroke-dasharray:2 3}.gps{stroke:var(--gps)}.other{stroke:var(--truth);stroke-dasharray:6 3}
svg .fill{stroke:none}svg .fill.yes{fill:var(--yes)}svg .fill.no{fill:var(--no)}svg .fill.faint{fill:var(--faint)}
svg .fill.after{fill:var(--after)}
.key{display:flex;flex-wrap:wrap;gap:4px 16px;font-size:.85rem;color:var(--quiet);margin:4px 0}
.key svg{width:26px;height:10px;display:inline-block;margin-right:5px;vertical-align:middle}
.warn{border-left:4px solid var(--truth);background:var(--card);padding:6px 10px;margin:6px 0}
.accepted{color:var(--yes)}.rejected{color:var(--no)}
select,#more{padding:3px 8px;font:inherit}
select,#more{color:inherit;background:var(--card);border:1px solid var(--line);border-radius:4px}
details{margin:.6em 0}summary{cursor:pointer}
pre{overflow-x:auto;background:var(--card);padding:10px;border-radius:6px;font-size:.8rem}
a{color:var(--after)}
@media (max-width:640px){svg text{font-size:18px}.key svg text{font-size:12px}}
@media print{#more,select{display:none}}
""".strip()

SCRIPT = """
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
""".strip()
