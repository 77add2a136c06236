"use strict";
(() => {
  const $ = (id) => document.getElementById(id), data = JSON.parse($("audit").textContent);
  const { columns, used, stamps, thumbnails, pictures, sentences } = data;
  const count = columns.row.length, names = Object.keys(columns);
  const isUsed = (row) => used.includes(columns.verdict[row]);
  const isFalse = (row) => isUsed(row) && columns.true?.[row] === "no";
  const kindOf = (row) => isFalse(row) ? "false" : isUsed(row) ? "yes"
    : columns.residual_after[row] !== null || columns.verdict[row] === "rejected_by_decision" ? "no" : "before";

  // Decisions: by "query,match"; those that the run followed are there from the start
  const decisions = new Map(), pairOf = (row) => columns.query[row] + "," + columns.match[row];
  columns.verdict.forEach((verdict, row) => {
    if (verdict.endsWith("_by_decision"))
      decisions.set(pairOf(row), { decision: verdict.startsWith("accepted") ? "accept" : "reject", who: "", when: "", reason: "" });
  });
  let unsaved = false, rows = [], selected = -1, answered = [], by = "inliers", down = true;

  const decide = (pairs, decision) => {
    unsaved = true;
    for (const pair of pairs) if (decision === null) decisions.delete(pair);
    else decisions.set(pair, { decision, who: $("who").value, when: new Date().toISOString(), reason: $("reason").value });
    $("reason").value = "";
    refresh();
  };
  const csv = () => {
    const quoted = (text) => '"' + text.replace(/[\r\n]+/g, " ").slice(0, 1000).replaceAll('"', '""') + '"';
    const lines = [...decisions].map(([pair, { decision, who, when, reason }]) =>
      [...pair.split(",").map((at) => stamps[at]), decision, quoted(who), when, quoted(reason)].join(","));
    return ["query,match,decision,who,when,reason", ...lines, ""].join("\n");
  };

  // Filter: words are looked for in verdict and decision, NAME<OPERATOR>NUMBER compares a column
  const aliases = { keyframe: ["query", "match"], residual: ["residual_after"] };
  const compare = { "<": (a, b) => a < b, ">": (a, b) => a > b, "=": (a, b) => a === b, "<=": (a, b) => a <= b, ">=": (a, b) => a >= b };
  const test = (term) => {
    const [, name, operator, number] = /^([a-z_]+)(<=|>=|<|>|=)(-?[\d.]+)$/.exec(term) ?? [];
    const of = (aliases[name] ?? [name]).filter((one) => columns[one]);
    if (of.length) return (row) => of.some((one) => columns[one][row] !== null && compare[operator](columns[one][row], +number));
    return (row) => (columns.verdict[row] + " " + (decisions.get(pairOf(row))?.decision ?? "") + " true:" + columns.true?.[row]).includes(term);
  };
  const order = () => {
    const wanted = $("filter").value, terms = $("search").value.toLowerCase().split(/\s+/).filter(Boolean).map(test);
    const column = columns[by], sign = down ? -1 : 1;
    rows = [...columns.row.keys()].filter((row) => (!wanted || (wanted === "*" ? kindOf(row) !== "before" : columns.verdict[row] === wanted))
      && terms.every((one) => one(row)));
    rows.sort((a, b) => {
      const x = column[a], y = column[b];
      if (x === y) return a - b;
      if (x === null) return 1;  // what is not known comes last, either way
      if (y === null) return -1;
      return (x < y ? -1 : 1) * sign;
    });
    $("count").textContent = rows.length + " of " + count + " candidates";
    drawMap(); refresh();
  };

  // The ledger: only the rows in view are in the document
  const box = $("ledger"), body = $("rows");
  let tall = 27;  // px of a row
  const spacer = (height) => {
    const tr = document.createElement("tr"), td = document.createElement("td");
    td.colSpan = names.length + 1; td.className = "spacer"; td.style.height = height + "px"; tr.append(td);
    return tr;
  };
  const line = (row) => {
    const tr = document.createElement("tr"), decision = decisions.get(pairOf(row))?.decision ?? "";
    tr.dataset.row = row; tr.setAttribute("aria-selected", row === selected);
    for (const value of [decision, ...names.map((name) => columns[name][row])]) {
      const td = document.createElement("td"); td.textContent = value ?? ""; tr.append(td);
    }
    tr.children[1 + names.indexOf("verdict")].className = isUsed(row) ? "accepted" : "rejected";
    return tr;
  };
  const drawLedger = () => {
    const first = Math.max(0, Math.min(Math.floor(box.scrollTop / tall) - 5, rows.length - 5));
    const last = Math.min(rows.length, first + Math.ceil(box.clientHeight / tall) + 10);
    body.replaceChildren(spacer(first * tall), ...rows.slice(first, last).map(line), spacer((rows.length - last) * tall));
    const is = body.children[1].getBoundingClientRect().height;
    if (last > first && is > 0 && Math.abs(is - tall) > .01) { tall = is; drawLedger(); }
  };

  // The map: metres to px by `view`; every closure is a dot of constant size at its query
  const canvas = $("map"), layer = document.createElement("canvas"), tip = $("tip"), xy = data.map.keyframes;
  let view = null, fitted = true, hovered = -1, pen = null;
  const place = ([x, y]) => [view.x + x * view.scale, view.y - y * view.scale];
  const fit = () => {
    fitted = true;
    const all = data.map.paths.flatMap((path) => path.points), width = canvas.clientWidth, height = canvas.clientHeight;
    const low = [0, 1].map((at) => all.reduce((least, p) => Math.min(least, p[at]), Infinity));
    const high = [0, 1].map((at) => all.reduce((most, p) => Math.max(most, p[at]), -Infinity));
    const scale = Math.min((width - 60) / Math.max(high[0] - low[0], 1e-6), (height - 80) / Math.max(high[1] - low[1], 1e-6));
    view = { scale, x: width / 2 - scale * (low[0] + high[0]) / 2, y: height / 2 + scale * (low[1] + high[1]) / 2 };
  };
  const zoom = (factor, x, y) => {
    fitted = false;
    view = { scale: view.scale * factor, x: x + (view.x - x) * factor, y: y + (view.y - y) * factor };
    drawMap();
  };
  const dotOf = (row) => place(xy[columns.query[row]]);
  const style = getComputedStyle(document.documentElement), colour = (name) => style.getPropertyValue("--" + name);
  const trace = (points, name, dashes, wide) => {
    pen.beginPath(); points.forEach((point) => pen.lineTo(...place(point)));
    pen.strokeStyle = colour(name); pen.setLineDash(dashes); pen.lineWidth = wide; pen.stroke(); pen.setLineDash([]);
  };
  const disc = ([x, y], radius, name) => {
    pen.beginPath(); pen.arc(x, y, radius, 0, 7); pen.fillStyle = colour(name); pen.fill();
  };
  const clear = (onto) => {
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    onto.width = width * ratio; onto.height = height * ratio;
    pen = onto.getContext("2d"); pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    return [width, height];
  };
  const highlight = () => {  // what is hovered and selected, on the map as it was drawn
    const size = clear(canvas);
    pen.drawImage(layer, 0, 0, ...size);
    for (const row of [hovered, selected]) if (row >= 0) {
      trace([xy[columns.match[row]], xy[columns.query[row]]], "ink", [], 2);
      for (const end of ["match", "query"]) disc(place(xy[columns[end][row]]), 6, "ink");
    }
  };
  const drawMap = () => {
    if (!view) fit();
    const [, height] = clear(layer);
    for (const { kind, points } of data.map.paths) {
      if (kind === "gps") points.forEach((point) => disc(place(point), 2, "gps"));
      else trace(points, kind, { before: [6, 4], truth: [2, 3] }[kind] ?? [], 2);
    }
    const residual = (row) => "hsl(" + Math.max(0, 130 - 20 * columns.residual_after[row]) + " 75% 45%)";
    for (const kind of ["before", "yes", "no", "false"]) for (const row of rows) {
      if (kindOf(row) !== kind) continue;
      const ends = [xy[columns.match[row]], xy[columns.query[row]]], name = { false: "no" }[kind] ?? kind;
      pen.globalAlpha = kind === "yes" || kind === "before" ? .35 : 1;
      trace(ends, name, kind === "no" ? [3, 2] : [], kind === "false" ? 3 : 1);
      pen.globalAlpha = 1;
      disc(dotOf(row), kind === "before" ? 2.5 : 4, name);
      if ($("colour").value === "residual" && columns.residual_after[row] !== null) {
        pen.fillStyle = residual(row); pen.fill();
      }
    }
    pen.fillStyle = colour("ink"); pen.font = "13px system-ui";
    for (const [at, word] of [[0, "start"], [xy.length - 1, "end"]]) {
      const [x, y] = place(xy[at]);
      disc([x, y], 5, "after");
      pen.strokeStyle = colour("paper"); pen.lineWidth = 4; pen.strokeText(word, x + 8, y - 8);
      pen.fillStyle = colour("ink"); pen.fillText(word, x + 8, y - 8);
    }
    const most = 120 / view.scale, power = 10 ** Math.floor(Math.log10(most)), metres = [5, 2, 1].find((one) => one * power <= most) * power;
    pen.fillStyle = colour("ink"); pen.fillRect(16, height - 16, metres * view.scale, 2);
    pen.fillText(+metres.toPrecision(1) + " m (" + data.map.axes + ")", 16, height - 22);
    highlight();
  };
  const nearest = (event, after = -1) => {  // of several under the pointer the one behind `after`
    const { left, top } = canvas.getBoundingClientRect(), x = event.clientX - left, y = event.clientY - top;
    const near = [];
    for (const row of rows) {
      const [a, b] = dotOf(row), apart = (a - x) ** 2 + (b - y) ** 2 - (kindOf(row) === "before" ? 0 : 20);
      if (apart < 10 ** 2) near.push([apart, row]);  // px
    }
    near.sort((one, other) => one[0] - other[0]);
    const at = near.findIndex(([, row]) => row === after);
    return near[(at + 1) % near.length]?.[1] ?? -1;
  };
  const fingers = new Map();
  let moved = 0;
  canvas.addEventListener("pointerdown", (event) => {
    fingers.set(event.pointerId, event); canvas.setPointerCapture(event.pointerId); moved = fingers.size > 1 ? 99 : 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId), { left, top } = canvas.getBoundingClientRect();
    if (!before) {
      const row = nearest(event);
      tip.hidden = row < 0;
      if (row >= 0) {
        tip.textContent = columns.query[row] + " to " + columns.match[row] + ": " + columns.verdict[row];
        tip.style.left = Math.min(event.clientX - left + 12, canvas.clientWidth - 200) + "px"; tip.style.top = event.clientY - top + 12 + "px";
      }
      if (row !== hovered) { hovered = row; highlight(); }
      return;
    }
    fingers.set(event.pointerId, event);
    const [other] = [...fingers.values()].filter((one) => one.pointerId !== event.pointerId);
    moved += Math.hypot(event.clientX - before.clientX, event.clientY - before.clientY);
    if (other) {
      const apart = (one) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
      zoom(apart(event) / Math.max(apart(before), 1), other.clientX - left, other.clientY - top);
    } else if (moved > 4) {
      fitted = false; view.x += event.clientX - before.clientX; view.y += event.clientY - before.clientY; drawMap();
    }
  });
  const lifted = (event) => {
    if (fingers.delete(event.pointerId) && event.type === "pointerup" && moved <= 4) select(nearest(event, selected));
  };
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, lifted);
  canvas.addEventListener("pointerleave", () => { tip.hidden = true; });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault(); zoom(Math.exp(-event.deltaY / 400), event.offsetX, event.offsetY);
  }, { passive: false });

  // The selected closure
  const show = () => {
    $("closure").hidden = selected < 0; $("hint").hidden = selected >= 0;
    if (selected < 0) return;
    const row = selected, verdict = columns.verdict[row], decision = decisions.get(pairOf(row))?.decision;
    $("closure-title").textContent = "Closure " + columns.row[row] + ": keyframe " + columns.query[row] + " as a return to " + columns.match[row];
    $("closure-verdict").textContent = verdict + ". " + sentences[verdict] + (decision ? " Your decision: " + decision + "." : "")
      + (answered.length > 1 ? " An answer is for all " + answered.length + " closures of its run." : "");
    $("closure-verdict").className = isUsed(row) ? "accepted" : "rejected";
    $("closure-numbers").textContent = names.filter((name) => !["row", "verdict", "query", "match"].includes(name) && columns[name][row] !== null)
      .map((name) => name + " " + columns[name][row]).join(", ");
    $("command").value = data.explain + columns.query[row] + ":" + columns.match[row];
    for (const end of ["query", "match"]) {
      const jpeg = thumbnails[columns[end][row]];
      $(end).hidden = !jpeg;
      if (jpeg) $(end).src = "data:image/jpeg;base64," + jpeg;
    }
    $("no-picture").hidden = [columns.query[row], columns.match[row]].every((at) => thumbnails[at]);
    $("full").hidden = !pictures.includes(columns.row[row]); $("full").href = "#closure-" + columns.row[row];
  };
  const select = (row, run = [row]) => {  // an answer is for all of a run where a question was selected
    selected = row; answered = run;
    const at = rows.indexOf(row);
    if (at >= 0 && (at * tall < box.scrollTop || (at + 3) * tall > box.scrollTop + box.clientHeight)) box.scrollTop = at * tall - box.clientHeight / 2;
    refresh();
  };
  const step = (by) => rows.length && select(rows[Math.min(Math.max(rows.indexOf(selected) + by, 0), rows.length - 1)]);
  function refresh() {
    drawLedger(); show(); highlight();
    for (const [tr, row] of questions) {
      tr.setAttribute("aria-selected", row === selected && answered.length > 1);
      tr.lastElementChild.textContent = decisions.get(pairOf(row))?.decision ?? "";
    }
    $("decided").textContent = decisions.size + (decisions.size === 1 ? " decision" : " decisions");
    $("download").disabled = !decisions.size && !unsaved;
  }
  const act = (decision) => selected >= 0 && decide(answered.map(pairOf), decision);
  const questions = [...document.querySelectorAll("#questions tr[data-closure]")].map((tr) => [tr, columns.row.indexOf(+tr.dataset.closure)]);
  for (const [tr, row] of questions) tr.addEventListener("click", () => { if (row >= 0) {
    select(row, data.questions[tr.dataset.closure].map((one) => columns.row.indexOf(one)).filter((one) => one >= 0));
    $("work").scrollIntoView();
  } });
  const keys = { j: () => step(1), k: () => step(-1), a: () => act("accept"), r: () => act("reject"), u: () => act(null) };
  document.addEventListener("keydown", (event) => {
    if (event.target.matches("input, select, textarea") || event.ctrlKey || event.metaKey || event.altKey) return;
    if (keys[event.key]) { event.preventDefault(); keys[event.key](); }
  });
  for (const [id, key] of [["accept", "a"], ["reject", "r"], ["undo", "u"], ["next", "j"], ["previous", "k"]]) $(id).addEventListener("click", keys[key]);
  $("add").addEventListener("click", () => {
    const ends = [+$("add-query").value, +$("add-match").value].sort((a, b) => b - a);
    const good = ends.every((at) => Number.isInteger(at) && at >= 0 && at < stamps.length) && ends[0] - ends[1] > 1;
    $("added").textContent = good ? "Added " + ends.join(" to ") + "." : "Give two keyframes of 0 to " + (stamps.length - 1) + " that are not neighbours.";
    if (good) decide([ends.join(",")], "add");
  });
  $("download").addEventListener("click", () => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([csv()], { type: "text/csv" })); link.download = "decisions.csv"; link.click();
    URL.revokeObjectURL(link.href); unsaved = false;
  });
  window.addEventListener("beforeunload", (event) => { if (unsaved) event.preventDefault(); });
  $("copy").addEventListener("click", () => { $("command").select(); navigator.clipboard?.writeText($("command").value); });
  body.addEventListener("click", (event) => { const tr = event.target.closest("tr[data-row]"); if (tr) select(+tr.dataset.row); });
  box.addEventListener("scroll", drawLedger);
  document.querySelectorAll("#closures th button").forEach((button) => button.addEventListener("click", () => {
    const name = button.textContent;
    down = by === name ? !down : columns[name].some((value) => typeof value === "number") && name !== "row"; by = name;
    document.querySelectorAll("#closures th").forEach((th) => th.textContent === name
      ? th.setAttribute("aria-sort", down ? "descending" : "ascending") : th.removeAttribute("aria-sort"));
    order();
  }));
  $("filter").addEventListener("change", order); $("search").addEventListener("input", order); $("colour").addEventListener("change", drawMap);
  for (const [id, factor] of [["zoom-in", 1.5], ["zoom-out", 1 / 1.5]]) $(id).addEventListener("click", () => zoom(factor, canvas.clientWidth / 2, canvas.clientHeight / 2));
  $("fit").addEventListener("click", () => { fit(); drawMap(); });
  window.addEventListener("resize", () => { if (fitted) fit(); drawMap(); drawLedger(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawMap);
  order();
})();
