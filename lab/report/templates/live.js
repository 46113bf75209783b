"use strict";
(() => {
  const el = (id) => document.getElementById(id), query = location.search;
  const shown = (v, digits) => (v === null || v === undefined ? "–" : v.toFixed(digits));
  const curves = [["x", "mm", 1000, 2, 8], ["y", "mm", 1000, 3, 9], ["z", "mm", 1000, 4, 10], ["yaw", "°", 1, 5, 11], ["pitch", "°", 1, 6, 12], ["roll", "°", 1, 7, 13]];
  for (const [name] of curves) {
    const figure = document.createElement("figure");
    figure.innerHTML = `<figcaption><span>${name}</span><span></span></figcaption><canvas role="img" aria-label="${name} of the last 20 seconds"></canvas>`;
    el("curves").append(figure);
  }

  // Pictures: the next one is fetched when the one before is drawn and a new state has come.
  const cameras = new Map([...document.querySelectorAll(".camera")].map((box) => [box.dataset.camera, { box, busy: false }]));
  async function picture(name, camera) {
    if (camera.busy || document.hidden) return;
    camera.busy = true;
    try {
      const answer = await fetch(`picture${query}${query ? "&" : "?"}camera=${encodeURIComponent(name)}`);
      if (answer.status !== 200) return; // 204: none yet
      const marks = JSON.parse(answer.headers.get("X-Marks"));
      const image = await createImageBitmap(await answer.blob());
      draw(camera.box.querySelector("canvas"), image, marks);
    } catch { /* the server has gone; the state says so */ } finally {
      camera.busy = false;
    }
  }
  function draw(canvas, image, marks) {
    const ratio = window.devicePixelRatio || 1, wide = canvas.clientWidth * ratio, scale = wide / marks.width, pen = canvas.getContext("2d");
    canvas.width = wide;
    canvas.height = marks.height * scale;
    pen.drawImage(image, 0, 0, canvas.width, canvas.height);
    pen.font = `600 ${13 * ratio}px system-ui, sans-serif`;
    for (const [u, v, label] of marks.marks) {
      const x = (u + 0.5) * scale, y = (v + 0.5) * scale, r = 9 * ratio;
      for (const [tone, width] of [["#000", 4], [label ? "#7CFC9A" : "#E69F00", 1.8]]) {
        pen.strokeStyle = tone;
        pen.lineWidth = width * ratio;
        pen.beginPath();
        pen.arc(x, y, r, 0, 2 * Math.PI);
        pen.stroke();
        if (tone === "#000") pen.strokeText(label, x + r + 3, y - r + 3);
      }
      pen.fillStyle = "#7CFC9A";
      pen.fillText(label, x + r + 3, y - r + 3);
    }
  }
  function list(camera, c) {
    const advice = camera.box.querySelector(".advice");
    advice.className = `advice ${c.level}`;
    advice.querySelector("span").textContent = c.advice;
    const offset = c.offset_ms === null ? "" : ` · ${shown(Math.abs(c.offset_ms), 1)} ms ${c.offset_ms < 0 ? "before" : "after"} the first camera`;
    camera.box.querySelector(".counts").textContent = `${shown(c.rate_hz, 1)} Hz · ${c.pictures} pictures · ${c.dropped} dropped frames · ${c.lost} lost or too late${offset}`;
    camera.box.querySelector("tbody").replaceChildren(...c.spots.map(([label, u, v, peak, width, clipped]) => {
      const row = document.createElement("tr");
      for (const text of [label || "no label", u.toFixed(2), v.toFixed(2), `${peak}${clipped ? " clipped" : ""}`, width.toFixed(2)]) row.insertCell().textContent = text;
      return row;
    }));
  }

  function curve(figure, rows, [, unit, factor, value, sigma]) {
    const digits = unit === "mm" ? 3 : 4;
    const canvas = figure.querySelector("canvas"), pen = canvas.getContext("2d"), ratio = window.devicePixelRatio || 1;
    const w = (canvas.width = canvas.clientWidth * ratio), h = (canvas.height = canvas.clientHeight * ratio);
    const known = rows.filter((r) => r[value] !== null), last = rows.at(-1);
    const now = last && last[value] !== null ? `${shown(factor * last[value], digits)} ± ${shown(factor * last[sigma], digits)} ${unit}` : "–";
    figure.querySelectorAll("figcaption span")[1].textContent = now;
    if (known.length < 2) return;
    let low = Infinity, high = -Infinity;
    for (const r of known) { low = Math.min(low, r[value]); high = Math.max(high, r[value]); }
    const least = 4 * known.map((r) => r[sigma]).sort((a, b) => a - b)[known.length >> 1], middle = (low + high) / 2, span = 1.15 * Math.max(high - low, least, 1e-9);
    const t1 = last[0], t0 = Math.min(rows[0][0], t1 - 1), x = (t) => ((t - t0) / (t1 - t0)) * w, y = (v) => h / 2 - ((v - middle) / span) * h;
    for (let i = 1; i < rows.length; i++) {
      const [a, b] = [rows[i - 1], rows[i]];
      if (a[value] === null || b[value] === null) continue;
      const colour = b[1] === "measured" ? "#2f8fd0" : "#E69F00";
      pen.fillStyle = `${colour}44`;
      pen.beginPath();
      for (const [r, side] of [[a, 1], [b, 1], [b, -1], [a, -1]]) pen.lineTo(x(r[0]), y(r[value] + side * r[sigma]));
      pen.fill();
      pen.strokeStyle = colour;
      pen.lineWidth = 1.6 * ratio;
      pen.beginPath();
      pen.moveTo(x(a[0]), y(a[value]));
      pen.lineTo(x(b[0]), y(b[value]));
      pen.stroke();
    }
  }

  function show(s) {
    el("state").textContent = s.over ? "The recording has ended; its results are being written." : s.frames ? `recording · ${Math.round(s.seconds)} s since the start` : "waiting for the first picture";
    el("frames").textContent = s.frames;
    el("measured").textContent = s.frames ? `${s.measured} measured (${((100 * s.measured) / s.frames).toFixed(1)} %)` : "";
    el("latency").textContent = s.latency_ms ? `${shown(s.latency_ms[0], 1)} ms` : "–";
    el("late").textContent = s.latency_ms ? `${shown(s.latency_ms[1], 1)} ms` : "–";
    const last = s.curves.at(-1);
    el("pose").textContent = last ? last[1] : "–";
    el("sigmas").textContent = last && last[8] !== null ? `sigma ${shown(1000 * Math.max(...last.slice(8, 11)), 2)} mm, ${shown(Math.max(...last.slice(11, 14)), 4)}°` : "";
    if (s.check.words) {
      el("check").className = `verdict ${s.check.level}`;
      el("word").textContent = { pass: "PASS", check: "CHECK", fail: "FAIL" }[s.check.level] ?? "";
      el("words").textContent = `Model check of the last seconds: ${s.check.words}`;
      el("remedy").textContent = s.check.remedy ?? "";
    }
    for (const c of s.cameras) {
      const camera = cameras.get(c.name);
      list(camera, c);
      picture(c.name, camera);
    }
    [...el("curves").children].forEach((figure, i) => curve(figure, s.curves, curves[i]));
  }
  const events = new EventSource(`state${query}`);
  events.onmessage = (e) => {
    const s = JSON.parse(e.data);
    show(s);
    if (s.over) events.close();
  };
  events.onerror = () => { el("state").textContent = "no connection: the watch has ended, or this page lacks its token"; };
})();
