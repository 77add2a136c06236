"use strict";
(() => {
  const $ = (id) => document.getElementById(id), data = JSON.parse($("audit").textContent);
  const { columns, used, stamps, thumbnails, sentences } = data;
  const count = columns.row.length, names = Object.keys(columns);
  const afterGeometry = new Set(["rejected_by_solver", "not_significant", "rejected_by_decision"]);
  const isUsed = (row) => used.includes(columns.verdict[row]);
  const isFalse = (row) => isUsed(row) && columns.true?.[row] === "no";
  const kindOf = (row) => isFalse(row) ? "false" : isUsed(row) ? "yes"
    : columns.residual_after[row] !== null || afterGeometry.has(columns.verdict[row]) ? "no" : "before";

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
    const [, name, operator, number] = /^([a-z_]+)(<=|>=|<|>|=)(-?[\d.]+(?:e[-+]?\d+)?)$/.exec(term) ?? [];
    const of = (aliases[name] ?? [name]).filter((one) => columns[one]);
    if (of.length) return (row) => of.some((one) => columns[one][row] !== null && compare[operator](columns[one][row], +number));
    return (row) => (columns.verdict[row] + " " + (decisions.get(pairOf(row))?.decision ?? "") + " true:" + columns.true?.[row] + " " + columns.change?.[row]).includes(term);
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

  // The stage: points in m to the right, up and out of the map, turned about their middle and seen from straight ahead.
  // Every closure is a dot of constant size, at its query; in the matrix at both of its keyframes
  const canvas = $("map"), layer = document.createElement("canvas"), tip = $("tip"), last = stamps.length - 1;
  let view = null, spots = [], paths = [], fitted = true, hovered = -1, moment = -1, pen = null;
  const is = (kind) => $("view").value === kind, flat = () => is("map") || is("matrix");
  const place = ([x, y, z]) => {
    const right = x - view.middle[0], up = y - view.middle[1], [c, s] = [Math.cos(view.turn), Math.sin(view.turn)];
    const away = Math.sin(view.tilt) * (s * right + c * up) + Math.cos(view.tilt) * (z - view.middle[2]);
    return [view.x + view.scale * (c * right - s * up), view.y - view.scale * away];
  };
  const range = (points, at) => points.reduce(([low, high], p) => [Math.min(low, p[at]), Math.max(high, p[at])], [Infinity, -Infinity]);
  const fit = () => {
    fitted = true;
    const all = [...spots, ...paths.flatMap((path) => path.points)], width = canvas.clientWidth, height = canvas.clientHeight;
    Object.assign(view, { scale: 1, x: 0, y: 0 });
    const seen = all.map(place), [low, high] = range(seen, 0), [top, foot] = range(seen, 1);
    view.scale = Math.min((width - 80) / Math.max(high - low, 1e-6), (height - 90) / Math.max(foot - top, 1e-6));
    view.x = width / 2 - view.scale * (low + high) / 2; view.y = height / 2 - view.scale * (top + foot) / 2;
  };
  const look = () => {
    const known = data.map.keyframes, extent = Math.max(...[0, 1].map((at) => { const [low, high] = range(known, at); return high - low; }));
    spots = is("matrix") ? known.map((_, at) => [at, at, 0])
      : is("time") ? known.map(([x, y], at) => [x, y, .7 * extent * at / Math.max(last, 1)]) : known;
    paths = is("matrix") ? [] : is("time") ? [{ kind: "after", points: spots }] : data.map.paths;
    const middle = [0, 1, 2].map((at) => { const [low, high] = range(spots, at); return (low + high) / 2; });
    view = { middle, ...(flat() ? { turn: 0, tilt: Math.PI / 2 } : { turn: .5, tilt: .6 }) };
    fit();
  };
  const zoom = (factor, x, y) => {
    fitted = false;
    view.scale *= factor; view.x = x + (view.x - x) * factor; view.y = y + (view.y - y) * factor;
    drawMap();
  };
  const dotOf = (row) => place(is("matrix") ? [columns.query[row], columns.match[row], 0] : spots[columns.query[row]]);
  const style = getComputedStyle(document.documentElement), colour = (name) => style.getPropertyValue("--" + name);
  const trace = (points, paint, dashes, wide) => {
    pen.beginPath(); points.forEach((point) => pen.lineTo(...place(point)));
    pen.strokeStyle = paint; pen.setLineDash(dashes); pen.lineWidth = wide; pen.stroke(); pen.setLineDash([]);
  };
  const disc = ([x, y], radius, paint) => {
    pen.beginPath(); pen.arc(x, y, radius, 0, 7); pen.fillStyle = paint; pen.fill();
  };
  const word = (text, x, y) => {
    pen.strokeStyle = colour("paper"); pen.lineWidth = 4; pen.strokeText(text, x, y);
    pen.fillStyle = colour("ink"); pen.fillText(text, x, y);
  };
  const scaled = (name, value) => {
    const [good, bad] = data.scales[name], share = Math.min(Math.max((value - good) / (bad - good), 0), 1);
    return value === null || value === undefined ? colour("before") : "hsl(" + 130 * (1 - share) + " 75% 45%)";
  };
  const clear = (onto, box = canvas) => {
    const ratio = window.devicePixelRatio || 1, width = box.clientWidth, height = box.clientHeight;
    onto.width = Math.max(width * ratio, 1); onto.height = Math.max(height * ratio, 1);
    pen = onto.getContext("2d"); pen.setTransform(ratio, 0, 0, ratio, 0, 0); pen.font = "13px system-ui";
    return [width, height];
  };
  const highlight = () => {  // what is hovered and selected, on the map as it was drawn, and on the charts
    const size = clear(canvas), ink = colour("ink");
    pen.drawImage(layer, 0, 0, ...size);
    if (moment >= 0) disc(place(spots[moment]), 6, colour("truth"));
    for (const row of [hovered, selected]) if (row >= 0) {
      const ends = ["match", "query"].map((end) => spots[columns[end][row]]);
      trace(is("matrix") ? [ends[0], [columns.query[row], columns.match[row], 0], ends[1]] : ends, ink, [], 2);
      for (const at of is("matrix") ? [dotOf(row)] : ends.map(place)) disc(at, 6, ink);
    }
    place_marks();
  };
  const round = (most) => {  // the largest 1, 2 or 5 times a power of ten up to it
    const power = 10 ** Math.floor(Math.log10(most));
    return [5, 2, 1].find((one) => one * power <= most) * power;
  };
  const drawAxes = (width, height) => {
    if (is("matrix")) {
      trace([[0, 0, 0], [last, last, 0]], colour("before"), [6, 4], 1);
      const step = Math.max(round(100 / view.scale), 1);
      for (let at = 0; at <= last; at += step) {
        const [x, y] = place([at, at, 0]);
        if (x > 60) word(at, x - 8, height - 8);
        if (y < height - 30) word(at, 8, y + 4);
      }
      word("query to the right, match up", 8, 18);
      return;
    }
    const metres = round(120 / view.scale);
    pen.fillStyle = colour("ink"); pen.fillRect(16, height - 16, metres * view.scale, 2);
    word(+metres.toPrecision(1) + " " + data.unit, 16, height - 22);
    const origin = place(view.middle), foot = [width - 60, height - 60];
    for (const [name, axis] of Object.entries(data.map.axes)) {
      const long = name === "N" ? 38 : 26, tip = place(axis.map((value, at) => view.middle[at] + value));
      const [x, y] = [0, 1].map((at) => long * (tip[at] - origin[at]) / view.scale);
      if (Math.hypot(x, y) < 8 || (is("time") && axis[2] > .5)) continue;
      pen.beginPath(); pen.moveTo(...foot); pen.lineTo(foot[0] + x, foot[1] + y);
      pen.strokeStyle = colour(name === "N" ? "no" : "quiet"); pen.lineWidth = 1.5; pen.stroke();
      word(name, foot[0] + 1.3 * x - 4, foot[1] + 1.3 * y + 4);
    }
  };
  const drawMap = () => {
    if (!view) look();
    const size = clear(layer), by = $("colour").value, error = by === "path_error_m" ? data.map.error_m : null;
    for (const { kind, points } of paths) {
      if (kind === "gps") points.forEach((point) => disc(place(point), 2, colour("gps")));
      else if (kind !== "after" || !error) trace(points, colour(kind), dashes[kind] ?? [], 2);
      else for (let at = 0; at < last; at++) trace(spots.slice(at, at + 2), scaled(by, error[at]), [], 4);
    }
    drawAxes(...size);
    for (const kind of ["before", "yes", "no", "false"]) for (const row of rows) {
      if (kindOf(row) !== kind) continue;
      const paint = colour(kind);
      pen.globalAlpha = kind === "yes" || kind === "before" ? .35 : 1;
      if (!is("matrix")) trace([spots[columns.match[row]], spots[columns.query[row]]], paint, kind === "no" ? [3, 2] : [], kind === "false" ? 3 : 1);
      pen.globalAlpha = 1;
      disc(dotOf(row), kind === "before" ? 2.5 : 4, columns[by] && by !== "verdict" ? scaled(by, columns[by][row]) : paint);
    }
    for (const [at, text] of is("matrix") ? [] : [[0, "start"], [last, "end"]]) {
      const [x, y] = place(spots[at]);
      disc([x, y], 5, colour("after")); word(text, x + 8, y - 8);
    }
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
      const [x, y] = [event.clientX - before.clientX, event.clientY - before.clientY];
      fitted = false;
      if (flat() || event.shiftKey) { view.x += x; view.y += y; }
      else { view.turn += x / 150; view.tilt = Math.min(Math.max(view.tilt + y / 150, 0), Math.PI / 2); }
      drawMap();
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

  // Charts: over time they share the pointer, whose moment the map shows; a click selects the closure nearest
  const seconds = data.seconds, dashes = { before: [6, 4], truth: [2, 3], other: [6, 3] };
  const axis = { stroke: () => colour("quiet"), grid: { stroke: () => colour("line"), width: 1 }, ticks: { show: false }, font: "12px system-ui" };
  const draw = (figure) => {
    const { kind, lines, thresholds, x, x_label } = JSON.parse($("charts").textContent)[figure.dataset.chart], time = kind === "time";
    const bars = kind === "bar" || kind === "mirrored", mirrored = kind === "mirrored", most = (u, at) => Math.max(...u.data[at].map(Math.abs), 1);
    const series = lines.map(([paint, label], at) => {
      const name = paint.replace("dot ", ""), dots = paint !== name, stroke = () => colour(name);
      return { label, stroke, dash: dots || bars ? [] : dashes[name], width: bars ? 0 : 2, spanGaps: kind === "curve", fill: bars ? stroke : null,
        scale: mirrored && at ? "down" : "y", paths: dots ? () => null : bars ? uPlot.paths.bars({ size: [.9], align: 1 }) : null,
        value: (u, value) => value === null ? "-" : +Math.abs(value).toPrecision(5) * (mirrored ? 1 : Math.sign(value)),
        points: { show: dots, size: 6, fill: stroke, width: 0 } };
    });
    const upright = { ...axis, size: 54, space: 34 }, down = { ...upright, scale: "down", side: 1, grid: { show: false } };
    const half = (sign) => (u, values) => values.map((value) => value * sign < 0 || value % 1 ? "" : Math.abs(value));
    const plot = new uPlot({
      width: figure.clientWidth, height: 230, series: [{ label: x_label, value: (u, value) => value === null ? "-" : +value.toPrecision(6) }, ...series],
      scales: { x: { time: false }, ...(mirrored ? { y: { range: (u) => [-1.3 * most(u, 1), 1.3 * most(u, 1)] }, down: { range: (u) => [-1.3 * most(u, 2), 1.3 * most(u, 2)] } } : bars ? { y: { range: (u, low, high) => [0, high] } } : {}) },
      axes: [{ ...axis, size: 30, ...(kind === "bar" ? { incrs: [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 5000] } : {}) }, ...(mirrored ? [{ ...upright, values: half(1) }, { ...down, values: half(-1) }] : [upright])],
      legend: { markers: { stroke: (u, at) => `var(--${lines[at - 1]?.[0].replace("dot ", "")})`, fill: "none", width: 2 } },
      cursor: { y: false, drag: { x: true, y: false }, ...(time ? { sync: { key: "time", scales: ["x", null] } } : {}) },
      hooks: { setScale: [() => place_marks()], draw: [(u) => thresholds.forEach(([text, at]) => {
        const place = Math.round(u.valToPos(at, "x", true)), { left, top, width, height } = u.bbox, ratio = devicePixelRatio;
        u.ctx.fillStyle = colour("ink"); u.ctx.fillRect(place, top, ratio, height); u.ctx.font = 12 * ratio + "px system-ui";
        u.ctx.textAlign = place > left + width / 2 ? "right" : "left"; u.ctx.fillText(text, place + (u.ctx.textAlign === "left" ? 5 : -5) * ratio, top + 12 * ratio);
      })] },
    }, [x, ...lines.map(([, , values]) => values)], figure);
    if (!time) return { figure, plot, marks: [] };
    const apart = (row) => Math.abs(columns.query[row] - moment);
    plot.over.addEventListener("pointermove", (event) => {
      const after = seconds.findIndex((one) => one >= plot.posToVal(event.offsetX, "x"));
      moment = after < 0 ? last : after; highlight();
    });
    plot.over.addEventListener("pointerleave", () => { moment = -1; highlight(); });
    plot.over.addEventListener("click", () => {
      const least = rows.reduce((most, row) => Math.min(most, apart(row)), Infinity), near = rows.filter((row) => apart(row) === least);
      if (near.length) select(near[(near.indexOf(selected) + 1) % near.length]);
    });
    const marks = ["query", "match"].map((end) => Object.assign(document.createElement("i"), { className: "mark " + end }));
    plot.over.append(...marks);
    return { figure, plot, marks };
  };
  const plots = [];
  const place_marks = () => {  // both keyframes of the closure that is hovered, else selected
    const row = hovered >= 0 ? hovered : selected;
    for (const { plot, marks } of plots) marks.forEach((mark, at) => {
      const x = row < 0 ? -1 : plot.valToPos(seconds[columns[["query", "match"][at]][row]], "x");
      mark.hidden = x < 0 || x > plot.over.clientWidth + 2; mark.style.left = x + "px";
    });
  };
  plots.push(...[...document.querySelectorAll("figure[data-chart]")].map(draw));

  // The selected closure
  const show = () => {
    $("closure").hidden = selected < 0; $("hint").hidden = selected >= 0;
    if (selected < 0) return;
    const row = selected, verdict = columns.verdict[row], decision = decisions.get(pairOf(row))?.decision;
    $("closure-title").textContent = "Closure " + columns.row[row] + ": keyframe " + columns.query[row] + " as a return to " + columns.match[row]
      + (columns.query_camera ? ", " + data.cameras[columns.query_camera[row]] + " and " + data.cameras[columns.match_camera[row]] : "");
    $("closure-verdict").textContent = verdict + ". " + sentences[verdict] + (decision ? " Your decision: " + decision + "." : "")
      + (answered.length > 1 ? " An answer is for all " + answered.length + " closures of its run." : "");
    $("closure-verdict").className = isUsed(row) ? "accepted" : "rejected";
    $("closure-numbers").textContent = names.filter((name) => !["row", "verdict", "query", "match"].includes(name) && columns[name][row] !== null)
      .map((name) => name + " " + columns[name][row]).join(", ");
    $("command").value = data.explain + columns.query[row] + ":" + columns.match[row];
    const jpegOf = (end) => { const camera = columns[end + "_camera"]?.[row]; return thumbnails[(camera ? camera + ":" : "") + columns[end][row]]; };
    for (const end of ["query", "match"]) {
      const jpeg = jpegOf(end);
      $(end).hidden = !jpeg;
      if (jpeg) $(end).src = "data:image/jpeg;base64," + jpeg;
    }
    const view = data.views[columns.row[row]], small = ["query", "match"].every(jpegOf);
    $("no-picture").textContent = small ? view ? "" : "The page has no matches of this pair; the command below draws them." : "No thumbnails of this pair are in the page.";
    $("references").replaceChildren(...panelsOf(view));
    overlay();
  };
  const bytes = (text) => Uint8Array.from(atob(text), (one) => one.charCodeAt(0));
  const panelsOf = (view) => (view?.references ?? []).filter((one) => data.references[one]).flatMap((reference, at) => {
    const titles = ["boxes of both", ...(at ? [] : view.votes.map((_, side) => "votes of the " + ["query", "match"][side]))];
    return titles.map((title, panel) => {
      const figure = document.createElement("figure"), image = new Image(), caption = document.createElement("figcaption");
      figure.className = "drawn"; image.alt = caption.textContent = "reference " + reference + ": " + title;
      image.addEventListener("load", overlay); image.src = "data:image/jpeg;base64," + data.references[reference];
      figure.append(image, document.createElement("canvas"), caption);
      figure.paint = (width, height) => panel ? heat(bytes(view.votes[panel - 1]), width, height)
        : view.boxes[at].forEach((text, side) => rectangles(bytes(text), width, height, ["#ff9d2e", "#4cc3ff"][side]));
      return figure;
    });
  });
  const rectangles = (all, width, height, paint) => {
    pen.strokeStyle = paint; pen.lineWidth = 1.5;
    for (let at = 0; at < all.length; at += 4) pen.strokeRect(all[at] / 255 * width, all[at + 1] / 255 * height, (all[at + 2] - all[at]) / 255 * width, (all[at + 3] - all[at + 1]) / 255 * height);
  };
  const heat = (votes, width, height) => {  // 18 rows of 32
    const grid = new OffscreenCanvas(32, 18), pixels = new ImageData(32, 18);
    votes.forEach((vote, at) => pixels.data.set([255, 210 - vote * .7, 40, vote * .75], 4 * at));
    grid.getContext("2d").putImageData(pixels, 0, 0); pen.drawImage(grid, 0, 0, width, height);
  };
  const overlay = () => {  // what is drawn over the pictures of the selected closure, at the size that they have now
    const view = data.views[columns.row[selected]], ends = [$("query"), $("match")];
    clear($("frames").lastElementChild, $("frames"));
    const all = bytes(view?.lines ?? ""), placed = (at, end) => [ends[end].offsetLeft + all[at + 2 * end] / 255 * ends[end].clientWidth, ends[end].offsetTop + all[at + 2 * end + 1] / 255 * ends[end].clientHeight];
    for (let at = all.length - 4; at >= 0; at -= 4) {
      pen.strokeStyle = at < 4 * view.agree ? "#35e06f" : "#ff4d3d"; pen.globalAlpha = at < 4 * view.agree ? .8 : .6;
      pen.beginPath(); pen.moveTo(...placed(at, 0)); pen.lineTo(...placed(at, 1)); pen.stroke();
    }
    for (const figure of $("references").children) figure.paint(...clear(figure.children[1], figure.children[0]));
  };
  for (const id of ["frames", "references"]) $(id).addEventListener("click", () => { $("closure").parentElement.classList.toggle("large"); overlay(); });
  for (const end of ["query", "match"]) $(end).addEventListener("load", () => overlay());
  $("query").addEventListener("load", (event) => {  // wide pictures one above the other
    event.target.parentElement.classList.toggle("stacked", event.target.naturalWidth > 2 * event.target.naturalHeight);
  });
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
  for (const [kind, row] of [["pointerover", (tr) => +tr.dataset.row], ["pointerleave", () => -1]])
    body.addEventListener(kind, (event) => { const tr = event.target.closest("tr[data-row]"); hovered = tr || kind === "pointerleave" ? row(tr) : -1; highlight(); });
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
  $("view").addEventListener("change", () => { look(); drawMap(); });
  for (const [id, factor] of [["zoom-in", 1.5], ["zoom-out", 1 / 1.5]]) $(id).addEventListener("click", () => zoom(factor, canvas.clientWidth / 2, canvas.clientHeight / 2));
  $("fit").addEventListener("click", () => { fit(); drawMap(); });
  window.addEventListener("resize", () => {
    if (fitted) fit();
    drawMap(); drawLedger();
    if (selected >= 0) overlay();
    for (const { figure, plot } of plots) plot.setSize({ width: figure.clientWidth, height: plot.height });
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { drawMap(); plots.forEach(({ plot }) => plot.redraw()); });
  order();
})();
