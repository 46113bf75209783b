// A common cursor for all plots over time: the time under the mouse is marked in every plot.
(() => {
  const plots = [...document.querySelectorAll("svg[data-t]")].map((svg) => {
    const [lo, hi, left, right] = svg.dataset.t.split(" ").map(Number);
    return { svg, lo, hi, left, right, line: null };
  });
  const box = document.createElement("div");
  box.id = "readout";
  document.body.append(box);
  const show = (t) => {
    for (const p of plots) {
      if (!p.line) {
        p.line = document.createElementNS("http://www.w3.org/2000/svg", "path");
        p.line.setAttribute("class", "cursor");
        p.svg.append(p.line);
      }
      const x = p.left + ((t - p.lo) / (p.hi - p.lo)) * (p.right - p.left);
      const inside = x >= p.left && x <= p.right;
      p.line.setAttribute("d", inside ? `M${x} 18V${p.svg.viewBox.baseVal.height - 8}` : "");
    }
    box.style.display = "block";
    box.textContent = `${document.body.dataset.time || "t"} = ${t.toFixed(3)}`;
  };
  for (const p of plots) {
    p.svg.addEventListener("mousemove", (event) => {
      const area = p.svg.getBoundingClientRect();
      const x = ((event.clientX - area.left) / area.width) * p.svg.viewBox.baseVal.width;
      const t = p.lo + ((x - p.left) / (p.right - p.left)) * (p.hi - p.lo);
      if (t >= p.lo && t <= p.hi) show(t);
    });
    p.svg.addEventListener("mouseleave", () => {
      for (const q of plots) q.line?.setAttribute("d", "");
      box.style.display = "none";
    });
  }
})();
