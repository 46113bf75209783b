// Plots over time: a common cursor with its values, and a common part of the time that is shown enlarged.
// Pages without the element #zoom-data have the cursor only; without JavaScript every plot shows the whole run.
(() => {
  "use strict";
  const NS = "http://www.w3.org/2000/svg";
  const numbers = (words) => (words ? words.split(" ").map(Number) : null);
  const make = (name, attributes, parent, words) => {
    const e = document.createElementNS(NS, name);
    for (const [key, value] of Object.entries(attributes)) e.setAttribute(key, value);
    if (words !== undefined) e.textContent = words;
    parent?.append(e);
    return e;
  };
  const html = (name, attributes, parent, words) => {
    const e = document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) e.setAttribute(key, value);
    if (words !== undefined) e.textContent = words;
    parent?.append(e);
    return e;
  };
  const plots = [...document.querySelectorAll("svg[data-t]")].map((svg) => {
    const [lo, hi, left, right] = numbers(svg.dataset.t);
    const y = numbers(svg.dataset.y);
    const whole = svg.querySelector("g.whole");
    const titled = (e) => [e, e.querySelector("title")?.textContent || ""];
    return {
      svg, lo, hi, left, right, y, whole,
      unit: svg.dataset.u || "", name: svg.dataset.name || "", fit: "fit" in svg.dataset,
      row: Number(svg.dataset.row ?? -1), tops: numbers(svg.dataset.tops), high: Number(svg.dataset.high),
      lines: [...svg.querySelectorAll("[data-s]")].map(titled), bands: [...svg.querySelectorAll("[data-b]")].map(titled),
      live: null, cursor: null, drawn: "", near: true,
    };
  });
  if (!plots.length) return;
  const timeName = plots.map((p) => p.name).find(Boolean) || "time (s)";
  const clock = timeName !== "frame";
  let store = null; // the decoded series
  let full = { lo: Math.min(...plots.map((p) => p.lo)), hi: Math.max(...plots.map((p) => p.hi)) };
  let view = null; // the enlarged part {lo, hi}; null: the whole run
  let cursor = null; // time
  let hovered = null; // the plot under the pointer

  // ---- the series -------------------------------------------------------------------------------------------------
  async function decoded() {
    const element = document.getElementById("zoom-data");
    if (!element || typeof DecompressionStream === "undefined") return null;
    const head = JSON.parse(element.textContent);
    const packed = Uint8Array.from(atob(head.data), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
    let at = 0;
    const integers = (count, width) => {
      const out = new Int32Array(count);
      for (let k = 0; k < width; k++) for (let i = 0; i < count; i++) out[i] |= bytes[at + k * count + i] << (8 * k);
      at += count * width;
      return out;
    };
    const times = ([first, step]) => {
      const steps = integers(head.n, 4);
      const out = new Float64Array(head.n);
      for (let i = 0, speed = 0, place = 0; i < head.n; i++) {
        speed = (speed + steps[i]) | 0;
        place += speed;
        out[i] = first + step * place;
      }
      return out;
    };
    const t = times(head.t), frames = times(head.frames);
    const rows = head.rows.map((row) => ({ ...row, codes: integers(head.n, 1) }));
    const places = head.series.map((s) => {
      const blocks = Math.ceil(head.n / s[5]), length = s[5] > 1 ? 2 * blocks : blocks;
      return [s, (at += length * s[4]) - length * s[4], blocks, length];
    });
    const ready = new Map();
    const series = (name) => {
      if (name.startsWith("=")) {
        const value = Number(name.slice(1));
        return { low: () => value, high: () => value, block: Infinity };
      }
      if (!ready.has(name)) {
        const [[centre, scale, lowest, step, width, block], start, blocks, length] = places[Number(name)];
        at = start;
        const q = integers(length, width), mask = 2 ** (8 * width) - 1, y = new Float64Array(length);
        for (let i = 0, sum = 0; i < length; i++) {
          sum = (sum + q[i]) & mask;
          y[i] = sum ? centre + scale * Math.sinh(lowest + (sum - 1) * step) : NaN;
        }
        const shift = block > 1 ? blocks : 0, which = block > 1 ? (i) => Math.floor(i / block) : (i) => i;
        ready.set(name, { low: (i) => y[which(i)], high: (i) => y[which(i) + shift], block });
      }
      return ready.get(name);
    };
    const band = (names) => {
      const parts = names.split(" ");
      const [a, b] = [series(parts[0]), series(parts[1])];
      const block = Math.min(a.block, b.block);
      if (parts.length === 2) return { low: a.low, high: b.high, block };
      const many = Number(parts[2]);
      return { low: (i) => a.low(i) - many * b.high(i), high: (i) => a.high(i) + many * b.high(i), block };
    };
    const most = Math.max(1, ...head.series.map((one) => one[5]));
    return { n: head.n, t, frames, rows, series, band, most };
  }
  /** The first index whose time is at least t. */
  function indexFrom(t) {
    let a = 0, b = store.n;
    while (a < b) {
      const middle = (a + b) >> 1;
      if (store.t[middle] < t) a = middle + 1;
      else b = middle;
    }
    return a;
  }
  function nearest(t) {
    const i = Math.min(indexFrom(t), store.n - 1);
    return i > 0 && t - store.t[i - 1] < store.t[i] - t ? i - 1 : i;
  }

  // ---- axes -------------------------------------------------------------------------------------------------------
  function ticks(lo, hi, about) {
    const raw = (hi - lo) / Math.max(about, 1), power = 10 ** Math.floor(Math.log10(raw));
    const step = power * ([1, 2, 5].find((m) => m * power >= raw * 0.999) || 10);
    const decimals = Math.min(Math.max(0, -Math.floor(Math.log10(step) + 1e-9)), 12);
    const out = [];
    for (let k = Math.ceil(lo / step - 1e-9); k <= hi / step + 1e-9; k++) {
      out.push([k * step, (k * step).toFixed(decimals).replace(/^-(0(\.0*)?)$/, "$1").replace("-", "\u2212")]);
    }
    return out;
  }
  const written = (value) => {
    if (!Number.isFinite(value)) return "\u2013";
    const size = Math.abs(value);
    const words = size && (size < 1e-4 || size >= 1e6) ? value.toExponential(3) : String(Number(value.toPrecision(5)));
    return words.replace("-", "\u2212");
  };
  const place = (p, t) => {
    const { lo, hi } = view && p.live ? view : p;
    return p.left + ((t - lo) / (hi - lo)) * (p.right - p.left);
  };

  // ---- drawing an enlarged part -----------------------------------------------------------------------------------
  /** Calls each(time, first frame, one past the last) for groups of at least `block` frames in the visible part. */
  function visit(p, block, each) {
    const least = Number.isFinite(block) ? block : store.n;
    const count = indexFrom(view.hi) - indexFrom(view.lo);
    const group = least * Math.max(1, Math.ceil(count / least / (p.right - p.left)));
    const a = Math.max(Math.floor(indexFrom(view.lo) / group) - 1, 0) * group;
    const b = Math.min((Math.ceil(indexFrom(view.hi) / group) + 1) * group, store.n);
    if (group >= store.n) { // a constant: its two ends
      each(store.t[0], 0, 1);
      each(store.t[store.n - 1], store.n - 1, store.n);
      return Infinity;
    }
    for (let i = a; i < b; i += group) {
      const end = Math.min(i + group, store.n);
      each((store.t[i] + store.t[end - 1]) / 2, i, end);
    }
    return group > 1 ? Infinity : b - a;
  }
  /** The smallest low and the largest high of the frames from..to - 1; NaN where there is none. */
  function edges(s, from, to) {
    let low = Infinity, high = -Infinity;
    for (let i = from; i < to; i += s.block) {
      const l = s.low(i), h = s.high(i);
      if (l < low) low = l;
      if (h > high) high = h;
    }
    return low <= high ? [low, high] : [NaN, NaN];
  }
  function visibleRange(p) {
    let lo = Infinity, hi = -Infinity;
    const add = (a, b) => { if (a < lo) lo = a; if (b > hi) hi = b; };
    const codes = store.rows[p.row]?.codes;
    const all = [...p.lines.map(([e]) => [store.series(e.dataset.s), false])];
    all.push(...p.bands.map(([e]) => [store.band(e.dataset.b), true]));
    visit(p, Math.min(...all.map(([s]) => s.block)), (t, from, to) => {
      if (t < view.lo || t > view.hi) return;
      for (const [s, isBand] of all) {
        if (isBand && codes && codes[from] !== 1) continue; // bands of predicted poses set no range
        add(...edges(s, from, to));
      }
    });
    if (!(lo <= hi)) return p.y.slice(0, 2);
    const pad = Math.max(0.06 * (hi - lo), 1e-9, 1e-6 * Math.abs(hi));
    return [lo - pad, hi + pad];
  }
  /** Whether blocks of a thinned series are wide enough on the screen to be drawn as boxes from low to high. */
  const boxed = (s, x0, x1) => s.block > 1 && Number.isFinite(s.block) && x1 - x0 > 3;
  function drawSeries(p, group, X, Y, lo, hi) {
    const [, , bottom, top] = p.y;
    const inner = make("svg", {
      x: p.left, y: top, width: p.right - p.left, height: bottom - top,
      viewBox: `${p.left} ${top} ${p.right - p.left} ${bottom - top}`,
    }, group);
    const clamp = (y) => Math.min(Math.max(y, lo), hi);
    for (const [e] of p.bands) {
      const s = store.band(e.dataset.b);
      let d = "", up = [], down = [];
      const close = () => {
        if (up.length) d += `M${up.concat(down.reverse()).join("L")}z`;
        [up, down] = [[], []];
      };
      visit(p, s.block, (t, from, to) => {
        const [low, high] = edges(s, from, to);
        if (Number.isNaN(low)) return close();
        const [x0, x1] = [X(border(from)), X(border(to))];
        for (const x of boxed(s, x0, x1) ? [x0, x1] : [X(t)]) {
          up.push(`${x.toFixed(1)} ${Y(clamp(high)).toFixed(1)}`);
          down.push(`${x.toFixed(1)} ${Y(clamp(low)).toFixed(1)}`);
        }
      });
      close();
      const path = e.cloneNode(true);
      path.setAttribute("d", d);
      inner.append(path);
    }
    for (const [e] of p.lines) {
      const s = store.series(e.dataset.s);
      const marks = new Set();
      let d = "", dots = "", ranges = "", run = 0, last = NaN;
      const point = (x, y) => {
        d += `${run++ ? "L" : "M"}${x} ${Y(clamp(y)).toFixed(1)}`;
        last = y;
      };
      const seen = visit(p, s.block, (t, from, to) => {
        const [low, high] = edges(s, from, to);
        if (Number.isNaN(low)) {
          if (run === 1) d += "h0";
          run = 0;
          return;
        }
        const x = X(t).toFixed(1);
        const inView = t >= view.lo && t <= view.hi;
        const [x0, x1] = [X(border(from)), X(border(to))];
        if (boxed(s, x0, x1)) {
          const [a, b] = [Y(clamp(low)).toFixed(1), Y(clamp(high)).toFixed(1)];
          ranges += `M${x0.toFixed(1)} ${a}H${x1.toFixed(1)}V${b}H${x0.toFixed(1)}z`;
        }
        const upFirst = Math.abs(low - last) <= Math.abs(high - last);
        point(x, upFirst ? low : high);
        if (high > low) point(x, upFirst ? high : low);
        if (high > hi && inView) marks.add(`M${5 * Math.round(x / 5) - 3} ${top}h6l-3 -5z`);
        if (low < lo && inView) marks.add(`M${5 * Math.round(x / 5) - 3} ${bottom}h6l-3 5z`);
        dots += `M${x} ${Y(clamp(low)).toFixed(1)}h0`;
      });
      if (run === 1) d += "h0";
      const path = e.cloneNode(true);
      path.setAttribute("d", ranges || d);
      if (ranges) { // single frames are not known: no line between them
        path.removeAttribute("class");
        for (const [key, value] of [["fill", e.getAttribute("stroke")], ["opacity", 0.4]]) path.setAttribute(key, value);
      }
      inner.append(path);
      if (seen < (p.right - p.left) / 8 && !e.hasAttribute("stroke-dasharray")) {
        make("path", { class: "line", d: dots, stroke: e.getAttribute("stroke"), "stroke-width": 3.4 }, inner);
      }
      if (marks.size) make("path", { d: [...marks].join(""), fill: e.getAttribute("stroke") }, group);
    }
  }
  const SHADES = {
    predicted: "predicted", lost: "lost", out_of_view: "outside", occluded: "predicted", no_image: "lost",
  };
  /** Calls each(code, first index, one past the last) for the runs of equal statuses in the visible part. */
  function runs(row, each) {
    const a = Math.max(indexFrom(view.lo) - 1, 0), b = Math.min(indexFrom(view.hi) + 1, store.n);
    for (let i = a, start = a; i < b; i++) {
      if (i + 1 === b || row.codes[i + 1] !== row.codes[i]) {
        each(row.codes[i] - 1, start, i + 1);
        start = i + 1;
      }
    }
  }
  const border = (i) =>
    i <= 0 ? store.t[0] - half() : i >= store.n ? store.t[store.n - 1] + half() : (store.t[i - 1] + store.t[i]) / 2;
  const half = () => (0.5 * (store.t[store.n - 1] - store.t[0])) / Math.max(store.n - 1, 1);
  function boxes(p, row, X, colourOf, top, high, group) {
    const parts = new Map(); // colour or class -> d
    const ends = new Map();
    runs(row, (code, from, to) => {
      const key = code >= 0 ? colourOf(row.words[code]) : undefined;
      if (!key) return;
      const x0 = Math.max(X(border(from)), p.left), x1 = Math.min(Math.max(X(border(to)), x0 + 0.8), p.right);
      if (x1 <= x0 || x1 < (ends.get(key) ?? -1) + 0.4) return; // within what is drawn
      ends.set(key, x1);
      parts.set(key, (parts.get(key) || "") + `M${x0.toFixed(1)} ${top}H${x1.toFixed(1)}v${high}H${x0.toFixed(1)}z`);
    });
    for (const [key, d] of parts) make("path", key.startsWith("#") ? { d, fill: key } : { d, class: `shade ${key}` }, group);
  }
  function draw(p) {
    const wanted = view && store && p.y ? `${view.lo} ${view.hi}` : "";
    if (wanted === p.drawn) return;
    p.live?.remove();
    p.live = null;
    p.drawn = wanted;
    p.svg.classList.toggle("zoomed", Boolean(wanted));
    if (!wanted) return;
    const group = make("g", { class: "live" });
    const [lo, hi] = p.fit ? visibleRange(p) : p.y;
    const [, , bottom, top] = p.y;
    const X = (t) => p.left + ((t - view.lo) / (view.hi - view.lo)) * (p.right - p.left);
    const Y = (y) => bottom + ((y - lo) / (hi - lo)) * (top - bottom);
    const row = store.rows[p.row];
    if (row) boxes(p, row, X, ([word]) => SHADES[word], top, bottom - top, group);
    let grid = "";
    if (!p.tops) {
      for (const [value, words] of ticks(lo, hi, Math.max(5, Math.floor((bottom - 20) / 22)))) {
        grid += `M${p.left} ${Y(value).toFixed(1)}H${p.right}`;
        make("text", { x: p.left - 6, y: Y(value) + 3.5, class: "end" }, group, words);
      }
    }
    for (const [value, words] of ticks(view.lo, view.hi, 6)) {
      grid += `M${X(value).toFixed(1)} ${top}V${bottom}`;
      if (p.name && X(value) < p.right - 46) make("text", { x: X(value), y: bottom + 15, class: "mid" }, group, words);
    }
    if (p.name) make("text", { x: p.right, y: bottom + 15, class: "end" }, group, p.name);
    make("path", { class: "grid", d: grid }, group);
    if (p.tops) p.tops.forEach((y, i) => boxes(p, store.rows[i], X, ([, colour]) => colour, y, p.high, group));
    else drawSeries(p, group, X, Y, lo, hi);
    p.whole.after(group);
    p.live = group;
  }

  // ---- the cursor -------------------------------------------------------------------------------------------------
  const maps = [...document.querySelectorAll("svg[data-map]")].map((svg) => ({
    svg, map: numbers(svg.dataset.map), uv: svg.dataset.uv.split(" "), colours: svg.dataset.colours.split(" "), dots: null,
  }));
  const shots = [...document.querySelectorAll("svg[data-at]")].map((svg) => ({ svg, at: Number(svg.dataset.at) }));
  const dock = html("aside", { id: "readout", "aria-label": "values at the cursor" }, document.body);
  let shown = null; // the picture in the dock
  function drawCursor() {
    const i = store && cursor !== null ? nearest(cursor) : -1;
    const t = i >= 0 ? store.t[i] : cursor;
    for (const p of plots) {
      const x = t === null ? -1 : place(p, t);
      const inside = x >= p.left - 0.01 && x <= p.right + 0.01;
      if (!inside && !p.cursor) continue;
      p.cursor ??= make("path", { class: "cursor" }, p.svg);
      const bottom = p.y ? p.y[2] : p.svg.viewBox.baseVal.height - 8;
      p.cursor.setAttribute("d", inside ? `M${x.toFixed(1)} ${p.y ? p.y[3] : 18}V${bottom}` : "");
    }
    for (const m of store ? maps : []) {
      m.dots ??= m.colours.map((stroke) => make("circle", { r: 6, class: "here", stroke }, m.svg));
      const [xl, xh, xa, xb, yl, yh, ya, yb] = m.map;
      m.dots.forEach((dot, j) => {
        const at = [0, 1].map((k) => (i < 0 ? NaN : store.series(m.uv[2 * j + k]).low(i)));
        const x = xa + ((at[0] - xl) * (xb - xa)) / (xh - xl), y = ya + ((at[1] - yl) * (yb - ya)) / (yh - yl);
        const inside = x >= Math.min(xa, xb) && x <= Math.max(xa, xb) && y >= Math.min(ya, yb) && y <= Math.max(ya, yb);
        dot.style.display = inside ? "" : "none";
        if (inside) {
          dot.setAttribute("cx", x.toFixed(1));
          dot.setAttribute("cy", y.toFixed(1));
        }
      });
    }
    readout(i, t);
    document.dispatchEvent(new CustomEvent("beampose-cursor", { detail: t })); // for the scene in three dimensions
  }
  function readout(i, t) {
    dock.style.display = t === null ? "none" : "block";
    if (t === null) return;
    dock.replaceChildren();
    const head = clock ? `t = ${t.toFixed(3)} s` : `frame ${Math.round(t)}`;
    html("strong", {}, dock, i >= 0 && clock ? `${head} \u00b7 frame ${store.frames[i]}` : head);
    if (i < 0) return;
    const values = html("table", {}, dock);
    const line = (name, s, isBand) => {
      const row = html("tr", {}, values), low = s.low(i), high = s.high(i);
      html("th", { scope: "row" }, row, name);
      const both = isBand ? low !== high : high > low;
      html("td", {}, row, `${both ? `${written(low)} to ${written(high)}` : written(low)} ${hovered.unit}`);
    };
    if (hovered) {
      const blocks = hovered.lines.map(([e]) => store.series(e.dataset.s).block).filter(Number.isFinite);
      for (const [e, name] of hovered.lines) line(name, store.series(e.dataset.s), false);
      for (const [e, name] of hovered.bands) line(name, store.band(e.dataset.b), true);
      const most = Math.max(1, ...blocks);
      if (most > 1) html("p", {}, dock, `\u201cto\u201d: smallest and largest of up to ${most} frames`);
    }
    const list = html("p", { class: "statuses" }, dock);
    for (const row of store.rows) {
      const [word, colour] = row.words[row.codes[i] - 1] || ["no row", "#8a8f98"];
      const item = html("span", {}, list);
      html("i", { style: `background:${colour}` }, item);
      item.append(`${row.name}: ${word.replaceAll("_", " ")}`);
    }
    if (!shots.length) return;
    const best = shots.reduce((a, b) => (Math.abs(b.at - t) < Math.abs(a.at - t) ? b : a));
    if (best !== shown?.of) {
      const copy = best.svg.cloneNode(true);
      for (const name of ["data-at", "data-frame"]) copy.removeAttribute(name);
      shown = { of: best, copy };
    }
    const gap = best.at - t;
    const unit = clock ? `${Math.abs(gap).toFixed(3)} s` : `${Math.abs(gap)} frames`;
    html("p", {}, dock, gap ? `nearest picture: ${unit} ${gap > 0 ? "after" : "before"} the cursor` : "picture of this frame");
    dock.append(shown.copy);
  }

  // ---- the shown part ---------------------------------------------------------------------------------------------
  let pending = 0;
  function refresh() {
    pending ||= requestAnimationFrame(() => {
      pending = 0;
      for (const p of plots) if (p.near) draw(p);
      drawCursor();
      if (bar) bar.update();
    });
  }
  let stored = 0;
  function show(lo, hi, keepAddress) {
    if (!store || !(hi > lo)) return;
    const whole = full.hi - full.lo, least = Math.min(whole, (4 * whole) / Math.max(store.n - 1, 4));
    const wide = Math.min(Math.max(hi - lo, least), whole), middle = (lo + hi) / 2;
    const from = Math.min(Math.max(middle - wide / 2, full.lo), full.hi - wide);
    view = wide >= whole * 0.9999 ? null : { lo: from, hi: from + wide };
    refresh();
    if (keepAddress) return;
    clearTimeout(stored);
    stored = setTimeout(() => {
      const words = view ? `#t=${Number(view.lo.toFixed(6))},${Number(view.hi.toFixed(6))}` : location.href.split("#")[0];
      try { history.replaceState(null, "", words); } catch { /* a page without an address of its own */ }
    }, 250);
  }
  const current = () => view || full;
  const zoom = (factor, at) => {
    const v = current(), about = at ?? (cursor !== null && cursor >= v.lo && cursor <= v.hi ? cursor : (v.lo + v.hi) / 2);
    show(about - (about - v.lo) * factor, about + (v.hi - about) * factor);
  };
  const pan = (share) => {
    const v = current(), by = share * (v.hi - v.lo);
    show(v.lo + by, v.hi + by);
  };
  const reset = () => show(full.lo, full.hi);
  function step(count) {
    const v = current();
    const i = cursor === null ? indexFrom(v.lo) : Math.min(Math.max(nearest(cursor) + count, 0), store.n - 1);
    cursor = store.t[i];
    if (view && (cursor < v.lo || cursor > v.hi)) show(cursor - (v.hi - v.lo) / 2, cursor + (v.hi - v.lo) / 2);
    refresh();
  }
  function fromAddress(scroll) {
    const found = /[#&]t=(-?[\d.eE+-]+),(-?[\d.eE+-]+)/.exec(location.hash);
    if (!found || !store) return;
    const [lo, hi] = [Number(found[1]), Number(found[2])];
    if (!(hi > lo) || hi <= full.lo || lo >= full.hi) return;
    const at = /[#&]at=(-?[\d.eE+-]+)/.exec(location.hash);
    if (at) cursor = Math.min(Math.max(Number(at[1]), full.lo), full.hi);
    show(lo, hi, true);
    if (scroll) (bar?.element.nextElementSibling || plots[0].svg).scrollIntoView();
  }
  function toolbar() {
    const element = html("div", { id: "timebar", role: "group", "aria-label": "shown part of the time" });
    const button = (sign, title, action) => {
      const b = html("button", { type: "button", title, "aria-label": title }, element, sign);
      b.addEventListener("click", action);
      return b;
    };
    button("\u2190", "earlier", () => pan(-0.5));
    button("\u2192", "later", () => pan(0.5));
    button("+", "enlarge", () => zoom(0.5));
    const smaller = button("\u2212", "show more time", () => zoom(2));
    const all = button("whole run", "show the whole run", reset);
    const slider = html("input", { type: "range", min: 0, max: store.n - 1, value: 0, "aria-label": "cursor" }, element);
    slider.addEventListener("input", () => {
      cursor = store.t[Number(slider.value)];
      step(0);
    });
    const words = html("span", { class: "shown" }, element);
    const help = html("details", {}, element);
    html("summary", {}, help, "keys");
    html("p", {}, help,
      "Drag over a plot: enlarge that time. Ctrl and wheel, or wheel after a click on a plot: zoom. Shift and drag, or "
      + "Shift and wheel: move. Double click: whole run. Touch: two fingers zoom, one finger moves. After a click on a "
      + "plot: arrows move the cursor by a frame, Shift and arrows the shown part, + and \u2212 zoom, 0 the whole run, "
      + "Escape removes the cursor. The address of the page keeps the shown part: copy it as a link.");
    const first = plots[0].svg.closest("section") || plots[0].svg;
    first.before(element);
    const update = () => {
      const v = current(), digits = clock ? 3 : 0;
      const frames = indexFrom(v.hi) - indexFrom(v.lo);
      const thin = store.most > 1 && (476 * store.most) / Math.max(frames, 1) > 3;
      words.textContent = `${v.lo.toFixed(digits)} to ${v.hi.toFixed(digits)}${clock ? " s" : ""}`
        + (thin ? ` \u00b7 boxes: range of up to ${store.most} frames; every value is in the tables` : "");
      all.disabled = smaller.disabled = !view;
      if (cursor !== null) slider.value = nearest(cursor);
      slider.setAttribute("aria-valuetext", cursor === null ? "no cursor" : dock.querySelector("strong")?.textContent || "");
    };
    return { element, update };
  }
  let bar = null;
  document.addEventListener("pointerdown", (event) => {
    if (event.target.closest("svg[data-t], #timebar, a") || cursor === null) return;
    cursor = hovered = null;
    refresh();
  });

  // ---- pointer, wheel, keys ---------------------------------------------------------------------------------------
  const fingers = new Map();
  let drag = null; // {p, x0, t0, moved, mode, box, view}
  const across = (p, clientX) => {
    const area = p.svg.getBoundingClientRect();
    return ((clientX - area.left) / area.width) * p.svg.viewBox.baseVal.width;
  };
  const timeAt = (p, clientX) => {
    const { lo, hi } = view && p.live ? view : p;
    return lo + ((across(p, clientX) - p.left) / (p.right - p.left)) * (hi - lo);
  };
  const within = (p, clientX) => {
    const x = across(p, clientX);
    return x >= p.left && x <= p.right;
  };
  function moved(p, event) {
    if (fingers.has(event.pointerId)) fingers.set(event.pointerId, event.clientX);
    if (drag && drag.p === p) {
      const wide = p.right - p.left, by = across(p, event.clientX) - drag.x0;
      if (Math.abs(by) > 4) drag.moved = true;
      if (fingers.size === 2 && drag.mode === "pinch") {
        const [a, b] = [...fingers.values()].map((x) => across(p, x));
        const scale = drag.apart / Math.max(Math.abs(a - b), 8), v = drag.view;
        const middle = v.lo + ((drag.middle - p.left) / wide) * (v.hi - v.lo), span = (v.hi - v.lo) * scale;
        const share = ((a + b) / 2 - p.left) / wide;
        return show(middle - share * span, middle + (1 - share) * span);
      }
      if (drag.mode === "pan" && drag.moved) {
        const dt = (-by / wide) * (drag.view.hi - drag.view.lo);
        return show(drag.view.lo + dt, drag.view.hi + dt);
      }
      if (drag.mode === "select" && drag.moved) {
        drag.box ??= make("rect", { class: "chosen", y: p.y[3], height: p.y[2] - p.y[3] }, p.svg);
        const [a, b] = [drag.x0, drag.x0 + by].map((x) => Math.min(Math.max(x, p.left), p.right)).sort((m, n) => m - n);
        drag.box.setAttribute("x", a);
        drag.box.setAttribute("width", b - a);
      }
    }
    if (event.pointerType === "touch" && view && drag?.mode !== "look") return;
    if (within(p, event.clientX)) {
      hovered = p;
      cursor = timeAt(p, event.clientX);
      refresh();
    }
  }
  function released(p, event) {
    fingers.delete(event.pointerId);
    if (!drag || drag.p !== p) return;
    const d = drag;
    drag = null;
    d.box?.remove();
    if (d.mode === "select" && d.moved && event.type === "pointerup") {
      const [a, b] = [d.t0, timeAt(p, event.clientX)].sort((m, n) => m - n);
      show(Math.max(a, current().lo), Math.min(b, current().hi));
    }
  }
  function listen(p) {
    const svg = p.svg;
    svg.setAttribute("tabindex", "-1");
    svg.addEventListener("pointerdown", (event) => {
      if (event.button || !within(p, event.clientX) || !p.y) return;
      fingers.set(event.pointerId, event.clientX);
      svg.focus({ preventScroll: true });
      const x0 = across(p, event.clientX), v = { ...current() };
      const touch = event.pointerType === "touch";
      drag = { p, x0, t0: timeAt(p, event.clientX), moved: false, view: v, box: null,
        mode: touch ? (view ? "pan" : "look") : event.shiftKey ? "pan" : "select" };
      if (fingers.size === 2) {
        const [a, b] = [...fingers.values()].map((x) => across(p, x));
        Object.assign(drag, { mode: "pinch", apart: Math.abs(a - b), middle: (a + b) / 2 });
      }
      svg.setPointerCapture?.(event.pointerId);
      moved(p, event);
    });
    svg.addEventListener("pointermove", (event) => moved(p, event));
    for (const name of ["pointerup", "pointercancel"]) svg.addEventListener(name, (event) => released(p, event));
    svg.addEventListener("pointerleave", (event) => {
      if (drag || event.pointerType === "touch" || document.activeElement === svg) return;
      hovered = cursor = null;
      refresh();
    });
    svg.addEventListener("dblclick", reset);
    svg.addEventListener("wheel", (event) => {
      if (!store || !within(p, event.clientX)) return;
      if (!(event.ctrlKey || event.metaKey || event.shiftKey || document.activeElement === svg)) return;
      event.preventDefault();
      const size = event.deltaMode === 1 ? 16 : 1;
      if (event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY)) pan(((event.deltaX || event.deltaY) * size) / 800);
      else zoom(Math.exp(Math.min(Math.max(event.deltaY * size, -200), 200) / 400), timeAt(p, event.clientX));
    }, { passive: false });
    svg.addEventListener("keydown", (event) => {
      const actions = {
        ArrowLeft: () => (event.shiftKey ? pan(-0.25) : step(-1)), ArrowRight: () => (event.shiftKey ? pan(0.25) : step(1)),
        "+": () => zoom(0.5), "=": () => zoom(0.5), "-": () => zoom(2), 0: reset, Home: reset,
        Escape: () => { cursor = hovered = null; svg.blur(); refresh(); },
      };
      if (!store || event.ctrlKey || event.metaKey || event.altKey || !actions[event.key]) return;
      event.preventDefault();
      hovered ??= p;
      actions[event.key]();
    });
  }

  for (const p of plots) listen(p);
  decoded().then((data) => {
    if (!data || data.n < 2) return;
    store = data;
    full = { lo: data.t[0], hi: data.t[data.n - 1] };
    for (const p of plots) p.svg.classList.add("zoomable");
    bar = toolbar();
    if (typeof IntersectionObserver !== "undefined") {
      const byElement = new Map(plots.map((p) => [p.svg, p]));
      const watcher = new IntersectionObserver((entries) => {
        for (const e of entries) byElement.get(e.target).near = e.isIntersecting;
        refresh();
      }, { rootMargin: "300px" });
      for (const p of plots) watcher.observe(p.svg);
    }
    fromAddress(false);
    refresh();
    window.addEventListener("hashchange", () => fromAddress(true));
  });
  // On paper every plot shows the whole run (style.css), and closed parts are opened.
  let closed = [];
  window.addEventListener("beforeprint", () => {
    closed = [...document.querySelectorAll("details:not([open])")].filter((d) => !d.closest("#timebar"));
    for (const d of closed) d.open = true;
  });
  window.addEventListener("afterprint", () => { for (const d of closed) d.open = false; });
  const copy = document.getElementById("copy-methods");
  copy?.removeAttribute("hidden");
  copy?.addEventListener("click", async () => {
    const words = document.getElementById("methods");
    try {
      await navigator.clipboard.writeText(words.innerText);
      copy.textContent = "copied";
    } catch {
      getSelection().selectAllChildren(words);
      copy.textContent = "selected: copy with Ctrl+C";
    }
  });
})();
