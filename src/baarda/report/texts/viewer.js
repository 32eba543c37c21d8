"use strict";
// Turns a block in space on a canvas: orthographic, no library, nothing loaded.
for (const box of document.querySelectorAll(".space")) {
  const scene = JSON.parse(box.querySelector("script").textContent);
  const canvas = box.querySelector("canvas"), told = box.querySelector("output"), pen = canvas.getContext("2d");
  const on = (name) => box.querySelector(`[name=${name}]`);
  const count = scene.names.length, words = scene.words;
  const ramp = ["#440154", "#482878", "#3e4989", "#31688e", "#26828e", "#1f9e89", "#35b779", "#6ece58", "#b5de2b", "#fde725"];
  let azimuth, elevation, zoom, shift, turned, flat = new Float64Array(2 * count), waiting = false;

  const reset = () => { [azimuth, elevation] = scene.view; zoom = 1; shift = [0, 0]; };
  const limits = (values) => {
    const sorted = values.filter((v) => v !== null && v > 0).sort((a, b) => a - b);
    const at = (q) => sorted.length ? sorted[Math.round(q * (sorted.length - 1))] : 0;
    return [at(0.02), at(0.98)];
  };
  const ends = { sigma: limits(scene.sigma), redundancy: limits(scene.redundancy) };

  function axes() {
    const a = azimuth * Math.PI / 180, e = elevation * Math.PI / 180;
    return [[-Math.sin(a), Math.cos(a), 0], [-Math.sin(e) * Math.cos(a), -Math.sin(e) * Math.sin(a), Math.cos(e)]];
  }
  function colour(i, by) {
    const value = scene[by][i], [low, high] = ends[by];
    if (value === null || (by === "sigma" && !(value > 0))) return null;
    const share = high > low ? Math.min(1, Math.max(0, (value - low) / (high - low))) : 0.5;
    return ramp[Math.round(share * (ramp.length - 1))];
  }
  function place(values, k, [right, up], scale, w, h) {
    const x = values[k], y = values[k + 1], z = values[k + 2];
    return [w / 2 + shift[0] + scale * (right[0] * x + right[1] * y + right[2] * z), h / 2 + shift[1] - scale * (up[0] * x + up[1] * y + up[2] * z)];
  }
  function line(points, close) {
    pen.beginPath();
    points.forEach((p, i) => i ? pen.lineTo(p[0], p[1]) : pen.moveTo(p[0], p[1]));
    if (close) pen.closePath();
    pen.stroke();
  }
  function draw() {
    waiting = false;
    const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
    if (canvas.width !== Math.round(w * ratio)) canvas.width = Math.round(w * ratio);
    if (canvas.height !== Math.round(h * ratio)) canvas.height = Math.round(h * ratio);
    const style = getComputedStyle(document.documentElement), ink = (name) => style.getPropertyValue(`--${name}`).trim();
    const view = axes(), [right, up] = view, scale = zoom * 0.47 * Math.min(w, h) / scene.radius, by = on("colour").value;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, w, h);
    pen.lineWidth = 0.8;
    for (let i = 0; i < count; i++) {
      const p = place(scene.points, 3 * i, view, scale, w, h);
      flat[2 * i] = p[0]; flat[2 * i + 1] = p[1];
    }
    turned = scene.images.map((_, i) => [0, 1, 2, 3, 4].map((k) => place(scene.cameras, 15 * i + 3 * k, view, scale, w, h)));
    if (on("rays").checked) {
      pen.strokeStyle = ink("orange");
      pen.globalAlpha = 0.7;
      for (let k = 0; k < scene.rays.length; k += 2) {
        const i = scene.rays[k + 1];
        line([turned[scene.rays[k]][0], [flat[2 * i], flat[2 * i + 1]]]);
      }
      pen.globalAlpha = 1;
    }
    if (on("ellipsoids").checked) {
      pen.strokeStyle = ink("muted");
      scene.ellipsoids.forEach((i, k) => {
        const [xx, xy, xz, yy, yz, zz] = scene.shapes.slice(6 * k, 6 * k + 6);
        const form = (u, v) => u[0] * (xx * v[0] + xy * v[1] + xz * v[2]) + u[1] * (xy * v[0] + yy * v[1] + yz * v[2]) + u[2] * (xz * v[0] + yz * v[1] + zz * v[2]);
        const a = form(right, right), b = form(right, up), c = form(up, up), middle = (a + c) / 2, root = Math.hypot((a - c) / 2, b);
        pen.beginPath();
        pen.ellipse(flat[2 * i], flat[2 * i + 1], scale * Math.sqrt(Math.max(0, middle + root)), scale * Math.sqrt(Math.max(0, middle - root)),
          -Math.atan2(2 * b, a - c) / 2, 0, 2 * Math.PI);
        pen.stroke();
      });
    }
    if (on("cameras").checked) {
      pen.strokeStyle = ink("blue");
      pen.fillStyle = ink("muted");
      pen.font = "11px sans-serif";
      turned.forEach((p, i) => {
        for (const k of [1, 2, 3, 4]) line([p[0], p[k]]);
        line(p.slice(1), true);
        if (turned.length <= 60) pen.fillText(scene.images[i].slice(0, 18), p[0][0] + 4, p[0][1] - 4);
      });
    }
    const size = count <= 1000 ? 2.6 : 1.6;
    for (let i = 0; i < count; i++) {
      const c = colour(i, by), x = flat[2 * i], y = flat[2 * i + 1];
      if (x < -5 || y < -5 || x > w + 5 || y > h + 5) continue;
      if (c) { pen.fillStyle = c; pen.beginPath(); pen.arc(x, y, size, 0, 7); pen.fill(); }
      if (scene.role[i] !== "i" || !c) { pen.strokeStyle = ink("ink"); pen.strokeRect(x - 3.5, y - 3.5, 7, 7); }
    }
    pen.strokeStyle = pen.fillStyle = ink("ink");
    pen.font = "12px sans-serif";
    "XYZ".split("").forEach((letter, k) => {
      const x = 42 + 30 * right[k], y = h - 42 - 30 * up[k];
      line([[42, h - 42], [x, y]]);
      pen.fillText(letter, 42 + 38 * right[k] - 4, h - 38 - 38 * up[k]);
    });
    legend(w, by, ink);
  }
  function legend(w, by, ink) {
    const left = w - 190, long = 150 / ramp.length, short = (v) => String(Number(v.toPrecision(3)));
    ramp.forEach((c, k) => { pen.fillStyle = c; pen.fillRect(left + k * long, 24, long + 0.5, 8); });
    pen.fillStyle = ink("ink");
    pen.fillText(by === "sigma" ? `${words.sigma} (${scene.told})` : words.redundancy, left - 40, 16, 225);
    pen.fillText(short(ends[by][0]), left, 46);
    const last = short(ends[by][1]);
    pen.fillText(last, left + 150 - pen.measureText(last).width, 46);
  }
  const later = () => { if (!waiting) { waiting = true; requestAnimationFrame(draw); } };
  const turn = (a, e) => { azimuth += a; elevation = Math.min(90, Math.max(-90, elevation + e)); later(); };
  const enlarge = (factor) => { zoom = Math.min(400, Math.max(0.2, zoom * factor)); shift = shift.map((s) => s * factor); later(); };
  function tell(x, y) {
    let best = 64, text = "";
    for (let i = 0; i < count; i++) {
      const d = (flat[2 * i] - x) ** 2 + (flat[2 * i + 1] - y) ** 2;
      if (d < best) {
        best = d;
        const s = scene.sigma[i], r = scene.redundancy[i];
        text = `${words.point} ${scene.names[i]}: ${words.sigma} ${s > 0 ? `${s} ${scene.told}` : words.fixed}` + (r === null ? "" : `, ${words.redundancy} ${r}`);
      }
    }
    if (on("cameras").checked) turned.forEach((p, i) => {
      const d = (p[0][0] - x) ** 2 + (p[0][1] - y) ** 2;
      if (d < best) { best = d; text = `${words.image} ${scene.images[i]}`; }
    });
    told.textContent = text || words.help;
  }
  let held = null;
  canvas.addEventListener("pointerdown", (e) => { held = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointerup", () => { held = null; });
  canvas.addEventListener("pointermove", (e) => {
    if (held) {
      const dx = e.clientX - held[0], dy = e.clientY - held[1];
      held = [e.clientX, e.clientY];
      if (e.shiftKey || e.buttons === 4) { shift = [shift[0] + dx, shift[1] + dy]; later(); } else turn(-0.4 * dx, 0.4 * dy);
    } else {
      const frame = canvas.getBoundingClientRect();
      tell(e.clientX - frame.left, e.clientY - frame.top);
    }
  });
  canvas.addEventListener("wheel", (e) => {
    if (document.activeElement !== canvas && !e.ctrlKey) return;  // the page scrolls until the view is chosen
    e.preventDefault();
    enlarge(Math.exp(-0.0015 * e.deltaY));
  }, { passive: false });
  const keys = { ArrowLeft: () => turn(5, 0), ArrowRight: () => turn(-5, 0), ArrowUp: () => turn(0, 5), ArrowDown: () => turn(0, -5),
    "+": () => enlarge(1.25), "=": () => enlarge(1.25), "-": () => enlarge(0.8), 0: () => { reset(); later(); } };
  canvas.addEventListener("keydown", (e) => { if (keys[e.key]) { e.preventDefault(); keys[e.key](); } });
  for (const control of box.querySelectorAll("select, input")) control.addEventListener("change", later);
  on("restart").addEventListener("click", () => { reset(); later(); });
  new ResizeObserver(later).observe(canvas);
  box.hidden = false;
  told.textContent = words.help;
  reset();
  later();
}
