"use strict";
(() => {
  const source = document.getElementById("scene-data");
  if (!source) return;
  const data = JSON.parse(source.textContent);
  if (data.packed) { // of a report: whole mm (lab/report/run/page.py)
    const metres = p => p && p.map(v => v / 1000);
    for (const line of data.lines) line.p = line.p.map(metres);
    data.moments = data.packed.map(([k, t, m, at, spots]) => {
      const vehicle = metres(at), places = spots.map(s => metres(s.slice(1, 4)));
      return {
        k, t, m, r: spots.map((s, i) => [s.length > 4 ? metres(s.slice(4)) : vehicle, places[i]]),
        s: [...spots.map((s, i) => [data.names[s[0]], "#E69F00", ...places[i]]), ["vehicle", "#CC79A7", ...vehicle]],
      };
    });
  }
  const canvas = document.getElementById("scene"), pen = canvas.getContext("2d");
  const slider = document.getElementById("scene-time"), play = document.getElementById("scene-play");
  const shown = document.getElementById("scene-moment"), moments = data.moments;
  const box = canvas.closest("[data-scene]"); // in a report: the drawings are shown until the scene is
  if (box) box.classList.add("live-scene");
  let turn = -0.6, tilt = 0.5, zoom = 1, playing = null;

  // The box of the scene and its centre.
  const low = [1e9, 1e9, 1e9], high = [-1e9, -1e9, -1e9];
  for (const line of data.lines) for (const p of line.p) if (p) for (let i = 0; i < 3; i++) {
    low[i] = Math.min(low[i], p[i]);
    high[i] = Math.max(high[i], p[i]);
  }
  const centre = low.map((v, i) => (v + high[i]) / 2);

  // World to the plane of the drawing, m: turned about z, then tilted; a parallel projection.
  const seen = p => {
    const x = p[0] - centre[0], y = p[1] - centre[1], z = p[2] - centre[2];
    const right = Math.cos(turn) * x - Math.sin(turn) * y, away = Math.sin(turn) * x + Math.cos(turn) * y;
    return [right, Math.cos(tilt) * z + Math.sin(tilt) * away];
  };
  // Half the width and height of the scene as it is seen first: it then fills nine tenths of the canvas.
  const half = [1e-3, 1e-3];
  for (const line of data.lines) for (const p of line.p) if (p) seen(p).forEach((v, i) => { half[i] = Math.max(half[i], Math.abs(v)); });
  const place = p => {
    const [right, up] = seen(p);
    const scale = zoom * 0.45 * Math.min(canvas.clientWidth / half[0], canvas.clientHeight / half[1]);
    return [canvas.clientWidth / 2 + scale * right, canvas.clientHeight / 2 - scale * up];
  };
  const trace = points => {
    pen.beginPath();
    let down = false;
    for (const p of points) {
      if (!p) { down = false; continue; }
      const [x, y] = place(p);
      if (down) pen.lineTo(x, y); else pen.moveTo(x, y);
      down = true;
    }
  };
  const label = (words, p) => {
    const [x, y] = place(p);
    pen.fillStyle = getComputedStyle(document.body).color;
    pen.fillText(words, Math.min(x + 6, canvas.clientWidth - pen.measureText(words).width - 4), y - 5);
  };

  function draw() {
    const ratio = window.devicePixelRatio || 1;
    canvas.width = canvas.clientWidth * ratio;
    canvas.height = canvas.clientHeight * ratio;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
    pen.font = "12px system-ui, sans-serif";
    for (const line of data.lines) {
      trace(line.p);
      if (line.f) { pen.globalAlpha = 0.12; pen.fillStyle = line.c; pen.fill(); pen.globalAlpha = 1; }
      pen.strokeStyle = line.c;
      pen.lineWidth = 1.2;
      pen.stroke();
      if (line.n && line.p[0]) label(line.n, line.p[0]);
    }
    if (!moments.length) return;
    const now = moments[Number(slider.value)];
    pen.strokeStyle = "#D55E00";
    for (const ray of now.r) { trace(ray); pen.stroke(); }
    for (const [name, colour, ...p] of now.s) {
      const [x, y] = place(p);
      pen.fillStyle = colour;
      pen.beginPath();
      pen.arc(x, y, 4, 0, 2 * Math.PI);
      pen.fill();
      label(name, p);
    }
    shown.textContent = moments.length < 2 ? "" : `frame ${now.k} · ${now.t.toFixed(2)} s${now.m ? "" : " · not measured"}`;
  }

  function stop() { playing = null; play.textContent = "Play"; }
  function advance() {
    if (!playing) return;
    const t = playing.t + (performance.now() - playing.clock) / 1000;
    let k = Number(slider.value);
    while (k < moments.length - 1 && moments[k + 1].t <= t) k++;
    slider.value = k;
    draw();
    if (k === moments.length - 1) stop(); else requestAnimationFrame(advance);
  }
  play.addEventListener("click", () => {
    if (playing) { stop(); return; }
    if (Number(slider.value) === moments.length - 1) slider.value = 0;
    playing = { clock: performance.now(), t: moments[Number(slider.value)].t };
    play.textContent = "Pause";
    requestAnimationFrame(advance);
  });
  slider.max = Math.max(moments.length - 1, 0);
  slider.value = data.first;
  slider.addEventListener("input", () => { stop(); draw(); });

  const limit = v => Math.max(-Math.PI / 2, Math.min(Math.PI / 2, v));
  let grip = null;
  canvas.addEventListener("pointerdown", e => { grip = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointermove", e => {
    if (!grip) return;
    turn += (e.clientX - grip[0]) / 200;
    tilt = limit(tilt + (e.clientY - grip[1]) / 200);
    grip = [e.clientX, e.clientY];
    draw();
  });
  canvas.addEventListener("pointerup", () => { grip = null; });
  // In a report the wheel scrolls the page until the scene is clicked.
  canvas.addEventListener("wheel", e => { if (box && document.activeElement !== canvas) return; e.preventDefault(); zoom *= Math.exp(-e.deltaY / 600); draw(); }, { passive: false });
  canvas.addEventListener("keydown", e => {
    const by = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[e.key];
    if (by) { turn += by[0]; tilt = limit(tilt + by[1]); }
    else if (e.key === "+") zoom *= 1.2;
    else if (e.key === "-") zoom /= 1.2;
    else return;
    e.preventDefault();
    draw();
  });
  // The report's cursor: the moment nearest to its time.
  document.addEventListener("beampose-cursor", e => {
    if (!moments.length || e.detail === null) return;
    let best = 0;
    moments.forEach((m, k) => { if (Math.abs(m.t - e.detail) < Math.abs(moments[best].t - e.detail)) best = k; });
    if (Number(slider.value) === best) return;
    stop();
    slider.value = best;
    draw();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  window.addEventListener("resize", draw);
  draw();
})();
