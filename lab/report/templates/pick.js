"use strict";
(() => {
  const data = JSON.parse(document.getElementById("pick-data").textContent);
  const el = (id) => document.getElementById(id);
  const canvas = el("photo"), pen = canvas.getContext("2d"), key = `beampose-pick-${data.id}`;
  const headers = { point: ["camera", "point", "u_px", "v_px", "sigma_px"], spot: ["frame", "camera", "spot", "u_px", "v_px", "sigma_px"] };
  const near = { mouse: 12, pen: 16, touch: 24 }; // CSS px from a click to its point
  const byEye = 2; // CSS px, 1 sigma of a place read by eye
  let named = []; // {kind, camera, frame, name, u, v, s}; frame: null for control points, which do not move
  let at = 0, picked = null, kind = data.kind, levels = null, shown = document.createElement("canvas");
  const views = data.pictures.map((p) => ({ scale: 0, x: 0, y: 0, black: p.black, white: p.white }));
  const picture = () => data.pictures[at], view = () => views[at];

  // Names -----------------------------------------------------------------------------------------------------------

  const here = (n) => n.kind === kind && n.camera === picture().camera && (kind === "point" || n.frame === picture().frame);
  const same = (a, b) => a.kind === b.kind && a.camera === b.camera && a.frame === b.frame && a.name === b.name;
  function say(words, wrong = false) {
    el("said").textContent = words;
    el("said").classList.toggle("wrong", wrong);
  }
  function keep() {
    try { localStorage.setItem(key, JSON.stringify({ named, kind })); } catch { /* storage is switched off */ }
  }
  function remove(n) {
    named = named.filter((m) => m !== n);
    if (picked === n) picked = null;
    keep();
    say(`${n.name} removed`);
    update();
  }
  function assign(text) {
    const name = text.trim();
    if (!picked) return say("First click a point in the picture.", true);
    if (!name) return say("Type a name, or choose one.", true);
    if (/^[=@]/.test(name) || (/^[+-]/.test(name) && !/^[\w.+-]*$/.test(name))) return say("A spreadsheet would read this name as a formula; choose another one.", true);
    const fresh = { kind, camera: picture().camera, frame: kind === "spot" ? picture().frame : null, name, u: picked.u, v: picked.v, s: picked.s };
    const before = named.find((m) => same(m, fresh));
    named = named.filter((m) => m !== picked && m !== before && !(here(m) && m.u === fresh.u && m.v === fresh.v));
    named.push(fresh);
    keep();
    say(before && before !== picked ? `${name} was at (${before.u.toFixed(1)}, ${before.v.toFixed(1)}); it is moved here` : `${name} at (${fresh.u.toFixed(2)}, ${fresh.v.toFixed(2)})`);
    picked = null;
    el("name").value = "";
    update();
    canvas.focus({ preventScroll: true });
  }
  function pick(point) {
    picked = point;
    el("name").value = point?.name ?? "";
    if (!point) say("");
    else if (point.name) say(`${point.name} is selected: type another name, or press Delete to remove it.`);
    else say(`${point.hand ? "No detected point here: a place read by eye" : "Detected point"} at (${point.u.toFixed(2)}, ${point.v.toFixed(2)}), sigma ${point.s.toPrecision(2)} px`);
    update();
  }
  const detected = () => picture().points.map(([u, v, s, peak]) => ({ u, v, s, peak }));
  const free = () => detected().filter((d) => !named.some((n) => here(n) && Math.hypot(n.u - d.u, n.v - d.v) < 0.01));
  function step(by) { // to the next point without a name
    const points = free();
    if (!points.length) return say("All detected points have a name.");
    const now = picked ? points.findIndex((d) => d.u === picked.u && d.v === picked.v) : -1;
    const next = points[(now + by + (now < 0 && by < 0 ? 1 : 0) + points.length) % points.length];
    centre(next);
    pick(next);
  }

  // Tables ----------------------------------------------------------------------------------------------------------

  function rowsOf(text) {
    const rows = [[]];
    for (const [, quoted, plain, end] of text.replace(/^\uFEFF/, "").matchAll(/(?:"((?:[^"]|"")*)"|([^,\r\n]*))(,|\r?\n|$)/g)) {
      rows.at(-1).push(quoted === undefined ? plain : quoted.replaceAll('""', '"'));
      if (end === "") break;
      if (end !== ",") rows.push([]);
    }
    return rows.filter((r) => r.length > 1 || r[0]);
  }
  function read(text, from) {
    const [head = [], ...rows] = rowsOf(text), column = (name) => head.indexOf(name);
    const of = column("spot") >= 0 ? "spot" : "point";
    const missing = headers[of].filter((c) => c !== "sigma_px" && column(c) < 0);
    if (missing.length) return say(`${from}: expected a column ${missing[0]}, got ${head.join(",").slice(0, 120)}`, true);
    const found = [];
    for (const [i, row] of rows.entries()) {
      const field = (name) => (row[column(name)] ?? "").trim();
      if (field("status") && !["matched", "turned"].includes(field("status"))) continue; // of a run's spots.csv
      const n = { kind: of, camera: field("camera"), frame: of === "spot" ? Number(field("frame")) : null, name: field(of), u: Number(field("u_px")), v: Number(field("v_px")), s: Number(field("sigma_px") || field("sigma_u_px")) || 0.2 };
      if (!n.camera || !n.name || !field("u_px") || !field("v_px") || !Number.isFinite(n.u + n.v + (n.frame ?? 0))) return say(`${from}: line ${i + 2}: expected ${headers[of].slice(0, -1).join(",")}, got ${row.join(",").slice(0, 80)}`, true);
      found.push(n);
    }
    named = [...named.filter((m) => !found.some((n) => same(m, n))), ...found];
    kind = of;
    keep();
    const elsewhere = found.filter((n) => !data.pictures.some((p) => p.camera === n.camera && (n.frame === null || n.frame === p.frame))).length;
    say(`${from}: ${found.length} names read${elsewhere ? `, ${elsewhere} of them of pictures that are not shown; they stay in the table` : ""}`);
    unpick();
  }
  function unpick() { picked = null; el("name").value = ""; update(); }
  const word = (text) => (/[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);
  function table() {
    const rows = named.filter((n) => n.kind === kind).sort((a, b) => a.camera.localeCompare(b.camera) || a.frame - b.frame || a.name.localeCompare(b.name, "en", { numeric: true }));
    const line = (n) => [...(kind === "spot" ? [n.frame] : []), word(n.camera), word(n.name), n.u.toFixed(4), n.v.toFixed(4), Number(n.s.toPrecision(3))].join(",");
    return [headers[kind].join(","), ...rows.map(line), ""].join("\n");
  }
  function save() {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([table()], { type: "text/csv" }));
    link.download = `${kind}s.csv`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  }

  // The picture -----------------------------------------------------------------------------------------------------

  function decode() {
    const p = picture(), image = new Image();
    levels = null;
    image.onload = () => {
      if (p !== picture()) return;
      shown.width = p.w;
      shown.height = p.h;
      const c = shown.getContext("2d", { willReadFrequently: true });
      c.drawImage(image, 0, 0);
      const rgba = c.getImageData(0, 0, p.w, p.h).data;
      levels = new Uint16Array(p.w * p.h);
      // 16 bits come as red (high byte) and green (low byte).
      for (let i = 0; i < levels.length; i++) levels[i] = p.bits > 8 ? 256 * rgba[4 * i] + rgba[4 * i + 1] : rgba[4 * i];
      stretch();
    };
    image.src = p.src;
  }
  function stretch() {
    if (!levels) return;
    const p = picture(), v = view(), c = shown.getContext("2d"), out = c.createImageData(p.w, p.h), words = new Uint32Array(out.data.buffer);
    const shade = new Uint32Array(p.top + 1), span = Math.max(v.white - v.black, 1);
    for (let i = 0; i <= p.top; i++) shade[i] = 0xff000000 | (Math.round(255 * Math.min(Math.max((i - v.black) / span, 0), 1)) * 0x010101);
    for (let i = 0; i < levels.length; i++) words[i] = shade[levels[i]];
    c.putImageData(out, 0, 0);
    refresh();
  }
  function fit() {
    const p = picture(), v = view();
    v.scale = Math.min(canvas.clientWidth / p.w, canvas.clientHeight / p.h);
    v.x = (canvas.clientWidth - p.w * v.scale) / 2;
    v.y = (canvas.clientHeight - p.h * v.scale) / 2;
    refresh();
  }
  // Integers are the centres of pixels in u and v; the upper left corner of the picture is at (-0.5, -0.5).
  const place = (u, v) => [view().x + (u + 0.5) * view().scale, view().y + (v + 0.5) * view().scale];
  const pixel = (x, y) => [(x - view().x) / view().scale - 0.5, (y - view().y) / view().scale - 0.5];
  function zoom(by, x = canvas.clientWidth / 2, y = canvas.clientHeight / 2) {
    const v = view(), next = Math.min(Math.max(v.scale * by, 0.02), 80), share = next / v.scale;
    v.x = x - share * (x - v.x);
    v.y = y - share * (y - v.y);
    v.scale = next;
    refresh();
  }
  function centre(point) {
    const [x, y] = place(point.u, point.v), v = view();
    if (x > 40 && y > 40 && x < canvas.clientWidth - 40 && y < canvas.clientHeight - 40) return;
    v.x += canvas.clientWidth / 2 - x;
    v.y += canvas.clientHeight / 2 - y;
  }
  function mark(point, radius, colour, width, words = "") {
    const [x, y] = place(point.u, point.v);
    if (x < -200 || y < -60 || x > canvas.clientWidth + 60 || y > canvas.clientHeight + 60) return;
    for (const [tone, wide] of [["#000", width + 2], [colour, width]]) {
      pen.strokeStyle = tone;
      pen.lineWidth = wide;
      pen.beginPath();
      if (point.hand) { pen.moveTo(x - radius, y); pen.lineTo(x + radius, y); pen.moveTo(x, y - radius); pen.lineTo(x, y + radius); }
      else pen.arc(x, y, radius, 0, 2 * Math.PI);
      pen.stroke();
    }
    if (!words) return;
    pen.lineWidth = 4;
    pen.strokeStyle = "#000";
    pen.strokeText(words, x + radius + 3, y - radius + 2);
    pen.fillStyle = colour;
    pen.fillText(words, x + radius + 3, y - radius + 2);
  }
  function draw() {
    const ratio = window.devicePixelRatio || 1, p = picture(), v = view();
    canvas.width = canvas.clientWidth * ratio;
    canvas.height = canvas.clientHeight * ratio;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.imageSmoothingEnabled = v.scale * ratio < 1;
    if (levels) pen.drawImage(shown, v.x, v.y, p.w * v.scale, p.h * v.scale);
    pen.font = "600 14px system-ui, sans-serif";
    for (const d of free()) mark(d, 8, "#E69F00", 1.3);
    for (const n of named) if (here(n)) mark(n, 9, "#7CFC9A", 1.8, n.name);
    if (picked) mark(picked, 13, "#5cc8ff", 2.4);
  }
  let waiting = false;
  function refresh() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; draw(); });
  }
  function update() { list(); refresh(); }
  function list() {
    const own = named.filter(here), all = named.filter((n) => n.kind === kind).length;
    el("count").textContent = `${own.length} named, ${free().length} detected points without a name`;
    el("save").textContent = `Download ${kind}s.csv`;
    el("save").disabled = !all;
    el("clear").disabled = !all;
    el("assign").disabled = !picked;
    el("kind").value = kind;
    const button = (text, label, act) => {
      const b = document.createElement("button");
      Object.assign(b, { type: "button", textContent: text, ariaLabel: label });
      b.addEventListener("click", act);
      return b;
    };
    const known = data.names[kind][picture().camera] ?? data.names[kind]["*"] ?? [], used = new Set(own.map((n) => n.name));
    el("choices").replaceChildren(...known.filter((n) => !used.has(n)).map((n) => button(n, `Name the selected point ${n}`, () => assign(n))));
    el("list").replaceChildren(...own.map((n) => {
      const row = document.createElement("tr");
      const cells = [button(n.name, `Go to ${n.name}`, () => { centre(n); pick(n); }), n.u.toFixed(2), n.v.toFixed(2), `± ${n.s.toPrecision(2)}`, button("×", `Remove ${n.name}`, () => remove(n))];
      for (const [i, content] of cells.entries()) {
        const cell = row.insertCell();
        cell.append(content);
        if (i > 0 && i < 4) cell.className = "number";
      }
      return row;
    }));
  }
  function select(i) {
    at = i;
    for (const name of ["black", "white"]) Object.assign(el(name), { max: picture().top, value: view()[name] });
    el("which").value = i;
    if (!view().scale) fit();
    decode();
    unpick();
  }

  // Mouse, fingers and keys -----------------------------------------------------------------------------------------

  const fingers = new Map();
  let grip = null;
  const spot = (e) => { const box = canvas.getBoundingClientRect(); return [e.clientX - box.left, e.clientY - box.top]; };
  const spread = () => { const [a, b] = [...fingers.values()]; return [Math.hypot(a[0] - b[0], a[1] - b[1]), (a[0] + b[0]) / 2, (a[1] + b[1]) / 2]; };
  canvas.addEventListener("pointerdown", (e) => {
    if (e.button) return;
    canvas.setPointerCapture(e.pointerId);
    fingers.set(e.pointerId, spot(e));
    grip = { from: spot(e), last: spot(e), moved: fingers.size > 1, apart: fingers.size === 2 ? spread() : null };
  });
  canvas.addEventListener("pointermove", (e) => {
    const [x, y] = spot(e), [u, v] = pixel(x, y), p = picture(), column = Math.round(u), row = Math.round(v);
    const inside = column >= 0 && row >= 0 && column < p.w && row < p.h;
    el("under").textContent = inside ? `u ${u.toFixed(1)}, v ${v.toFixed(1)} px · grey value ${levels ? levels[row * p.w + column] : "–"} · ${Math.round(100 * view().scale)} %` : "";
    if (!grip || !fingers.has(e.pointerId)) return;
    fingers.set(e.pointerId, [x, y]);
    if (fingers.size === 2 && grip.apart) {
      const now = spread();
      view().x += now[1] - grip.apart[1];
      view().y += now[2] - grip.apart[2];
      zoom(now[0] / Math.max(grip.apart[0], 1), now[1], now[2]);
      grip.apart = now;
      return;
    }
    if (Math.hypot(x - grip.from[0], y - grip.from[1]) > 4) grip.moved = true;
    if (grip.moved) { view().x += x - grip.last[0]; view().y += y - grip.last[1]; refresh(); }
    grip.last = [x, y];
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (e) => {
    const was = grip;
    if (!fingers.delete(e.pointerId) || !was) return;
    grip = fingers.size ? { ...was, moved: true, last: [...fingers.values()][0], apart: null } : null;
    if (was.moved || name === "pointercancel") return;
    const [x, y] = spot(e), reach = near[e.pointerType] ?? 12, away = (d) => { const [a, b] = place(d.u, d.v); return Math.hypot(a - x, b - y); };
    const best = [...named.filter(here), ...free()].sort((a, b) => away(a) - away(b))[0], [u, v] = pixel(x, y), p = picture();
    if (best && away(best) <= reach) pick(best);
    else if (u >= -0.5 && v >= -0.5 && u < p.w - 0.5 && v < p.h - 0.5) pick({ u, v, s: Math.max(byEye / view().scale, 0.2), hand: true });
    else pick(null);
    if (picked && e.pointerType !== "touch") el("name").focus({ preventScroll: true });
  });
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); zoom(Math.exp(-e.deltaY * (e.deltaMode === 1 ? 16 : 1) / 500), ...spot(e)); }, { passive: false });
  canvas.addEventListener("keydown", (e) => {
    const move = (x, y) => () => { view().x += x; view().y += y; refresh(); };
    const actions = {
      ArrowLeft: move(60, 0), ArrowRight: move(-60, 0), ArrowUp: move(0, 60), ArrowDown: move(0, -60), "+": () => zoom(1.3), "=": () => zoom(1.3), "-": () => zoom(1 / 1.3), 0: fit,
      n: () => step(1), p: () => step(-1), Enter: () => el("name").focus(), Escape: () => pick(null), Delete: () => { if (picked?.name) remove(picked); },
    };
    if (e.ctrlKey || e.metaKey || e.altKey || !actions[e.key]) return;
    e.preventDefault();
    actions[e.key]();
  });
  el("name").addEventListener("keydown", (e) => { if (e.key === "Escape") { pick(null); canvas.focus(); } });
  el("naming").addEventListener("submit", (e) => { e.preventDefault(); assign(el("name").value); });
  el("nearer").addEventListener("click", () => zoom(1.3));
  el("farther").addEventListener("click", () => zoom(1 / 1.3));
  el("fit").addEventListener("click", fit);
  el("kind").addEventListener("change", () => { kind = el("kind").value; keep(); unpick(); });
  el("which").addEventListener("change", () => select(Number(el("which").value)));
  for (const name of ["black", "white"]) el(name).addEventListener("input", () => { view()[name] = Number(el(name).value); stretch(); });
  el("grey").addEventListener("click", () => {
    Object.assign(view(), { black: picture().black, white: picture().white });
    for (const name of ["black", "white"]) el(name).value = view()[name];
    stretch();
  });
  el("save").addEventListener("click", save);
  el("clear").addEventListener("click", () => {
    const own = named.filter((n) => n.kind === kind).length;
    if (!confirm(`Remove all ${own} names?`)) return;
    named = named.filter((n) => n.kind !== kind);
    keep();
    say("All names are removed.");
    unpick();
  });
  el("file").addEventListener("change", async () => {
    const [file] = el("file").files;
    if (file) read(await file.text(), file.name);
    el("file").value = "";
  });
  let width = 0;
  new ResizeObserver(() => { if (canvas.clientWidth !== width) { width = canvas.clientWidth; fit(); } else refresh(); }).observe(canvas);

  for (const [i, p] of data.pictures.entries()) el("which").add(new Option(p.label, i));
  let kept = null;
  try { kept = JSON.parse(localStorage.getItem(key)); } catch { /* storage is switched off */ }
  if (kept) ({ named, kind } = kept);
  else if (data.table) read(data.table.text, data.table.name);
  select(0);
  if (kept?.named.length) say(`${kept.named.length} names of your last visit to this page`);
})();
