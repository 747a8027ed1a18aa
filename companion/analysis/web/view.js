"use strict";
// Charts (uPlot) and maps (canvas) of the report and of the live view. `new Group()` links time axes and cursors.
// Text from logs is set as text only, never as HTML.

const SVG = "http://www.w3.org/2000/svg";
const darkness = matchMedia("(prefers-color-scheme: dark)");
const isDark = () => darkness.matches && document.documentElement.dataset.theme !== "light";
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const colourOf = (line) => line.colour[isDark() ? 1 : 0];
const FONT = '12px system-ui, -apple-system, "Segoe UI", Roboto, sans-serif';

/** Time since the start as m:ss, with tenths on demand. */
function clock(s, tenths = false) {
  const sign = s < 0 ? "-" : "";
  const n = tenths ? Math.round(Math.abs(s) * 10) / 10 : Math.round(Math.abs(s));
  const rest = (n % 60).toFixed(tenths ? 1 : 0);
  return `${sign}${Math.floor(n / 60)}:${rest.padStart(tenths ? 4 : 2, "0")}`;
}

function readable(v) {
  const a = Math.abs(v);
  return a >= 1000 ? Math.round(v).toLocaleString("en").replaceAll(",", "\u202f") : a >= 100 ? v.toFixed(0) : String(+v.toPrecision(3));
}

function element(tag, attributes = {}, ...children) {
  const found = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === "on") for (const [event, act] of Object.entries(value)) found.addEventListener(event, act);
    else found.setAttribute(name, value);
  }
  found.append(...children);
  return found;
}

/** Metres in a degree north and east at a latitude (deg), WGS 84: those that the map was made with. */
function metresPerDegree(lat) {
  const radian = Math.PI / 180, e2 = 0.00669437999014, w = 1 - e2 * Math.sin(lat * radian) ** 2;
  const radius = 6378137 / Math.sqrt(w);
  return [radius * (1 - e2) / w * radian, radius * Math.cos(lat * radian) * radian];
}

/** Index of the value nearest to t in an increasing list. */
function nearest(list, t) {
  let low = 0, high = list.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (list[middle] < t) low = middle; else high = middle;
  }
  return t - list[low] < list[high] - t ? low : high;
}

class Group {
  constructor() { this.charts = []; this.maps = []; this.key = `g${Group.count++}`; this.range = null; Group.last = this; }

  /** Show x from..to (s) in all charts; null shows everything. */
  zoom(range) {
    this.range = range;
    for (const chart of this.charts) chart.rescale();
  }

  full() {
    const ends = this.charts.map((chart) => chart.ends()).filter(Boolean);
    return ends.length ? [Math.min(...ends.map((e) => e[0])), Math.max(...ends.map((e) => e[1]))] : [0, 1];
  }

  /** Mark the time t (s) on the maps; null removes the mark. */
  point(t) { for (const map of this.maps) map.mark(t); }
}
Group.count = 0;

function textWidth(text, font) {
  const ctx = document.createElement("canvas").getContext("2d");
  ctx.font = font;
  return ctx.measureText(text).width;
}

function legendOf(lines, toggle) {
  const legend = element("div", { class: "legend" });
  lines.forEach((line, k) => {
    if (!line.name) return;
    const swatch = document.createElementNS(SVG, "svg");
    swatch.setAttribute("width", 18); swatch.setAttribute("height", 10);
    const shape = document.createElementNS(SVG, line.dots ? "circle" : "line");
    const set = (values) => Object.entries(values).forEach(([n, v]) => shape.setAttribute(n, v));
    if (line.dots) set({ cx: 9, cy: 5, r: 3.5 });
    else set({ x1: 0, x2: 18, y1: 5, y2: 5, "stroke-width": 3, "stroke-dasharray": line.dash ? "5 3" : "none" });
    shape.classList.add("swatch");
    shape.line = line;
    swatch.append(shape);
    legend.append(element("button", { type: "button", "aria-pressed": "true", on: { click: (event) => {
      const on = event.currentTarget.getAttribute("aria-pressed") !== "true";
      event.currentTarget.setAttribute("aria-pressed", on);
      toggle(k, on);
    } } }, swatch, line.name));
  });
  return legend;
}

function paintLegends() {
  for (const shape of document.querySelectorAll(".swatch")) {
    shape.setAttribute(shape.line.dots ? "fill" : "stroke", colourOf(shape.line));
  }
}

class Chart {
  constructor(box, figure, group, height) {
    Object.assign(this, { box, figure, group, height: height || (figure.rows.length ? 60 + 26 * figure.rows.length : 260) });
    this.hidden = new Set();
    this.hover = element("div", { class: "hover", hidden: "" });
    group.charts.push(this);
    this.build();
    new ResizeObserver(() => this.resize()).observe(box);
  }

  ends() {
    const x = this.data[0];
    return x.length ? [x[0], x[x.length - 1]] : null;
  }

  joined() {
    const log = this.figure.log;
    const tables = this.figure.lines.map((line) => [line.x, log ? line.y.map((v) => (v > 0 ? v : null)) : line.y]);
    return tables.length ? uPlot.join(tables, tables.map(() => [0, 2])) : [[]];  // 2: a null is a gap up to its next value
  }

  build() {
    const { figure, group } = this, rows = figure.rows, narrow = this.box.clientWidth < 560;
    this.data = this.joined();
    this.names = figure.lines.map((line) => line.name).join("\n");
    const axis = { stroke: () => css("--soft"), grid: { stroke: () => css("--grid"), width: 1 }, ticks: { stroke: () => css("--line"), width: 1, size: 5 }, font: FONT };
    const y = { auto: true };
    if (figure.log) {
      const level = figure.level;  // kept in view
      const within = (low, high) => (level === null ? [low, high] : [Math.min(low ?? level, level / 1.5), Math.max(high ?? level, level * 1.5)]);
      Object.assign(y, { distr: 3, log: 10, range: (u, low, high) => uPlot.rangeLog(...within(low ?? 1, high ?? 10), 10, false) });
    }
    if (rows.length) Object.assign(y, { dir: -1, range: [0.4, rows.length + 0.6] });
    else if (figure.view) y.range = (u, low, high) => (this.group.range ? uPlot.rangeNum(low, high, 0.1, true) : figure.view);
    else if (figure.zero) y.range = (u, low, high) => [0, Math.max(1, high * 1.1)];
    const decades = (u, splits) => splits.map((v) => (Math.abs(Math.log10(v) % 1) < 1e-6 ? v : null));
    const filtered = figure.log ? { grid: { ...axis.grid, filter: decades }, ticks: { ...axis.ticks, filter: decades } } : {};
    const rowFont = narrow ? FONT.replace("12", "10") : FONT;
    const widest = Math.max(0, ...rows.map((name) => textWidth(name, rowFont)));
    const options = {
      width: Math.max(200, this.box.clientWidth), height: this.height,
      legend: { show: false },
      scales: { x: { time: false, auto: false, range: (u, low, high) => [low, high] }, y },
      cursor: {
        sync: { key: group.key, setSeries: false, scales: ["x", null] },
        drag: { x: true, y: false, setScale: false }, y: false,
        bind: { dblclick: () => () => { group.zoom(null); return null; } },
        points: { show: !rows.length, size: 6 },
        dataIdx: (u, series, at) => this.known(series, at),
      },
      series: [{}, ...figure.lines.map((line, k) => ({
        label: line.name || " ", show: !this.hidden.has(k), stroke: () => colourOf(line), width: line.dots ? 0 : line.width,
        dash: line.dash ? [6, 4] : undefined, spanGaps: false,
        paths: line.dots ? () => null : undefined,
        points: line.dots ? { show: true, size: 4, fill: () => colourOf(line), stroke: () => colourOf(line), width: 0 } : { show: false },
      }))],
      axes: [
        { ...axis, incrs: [0.1, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 18000], space: narrow ? 46 : 60, values: (u, all, i, space, step) => all.map((v) => clock(v, step < 1)), size: 30 },
        rows.length
          ? { ...axis, splits: () => rows.map((_, k) => k + 1), values: () => rows, size: Math.min(this.box.clientWidth / 2, 14 + widest), font: rowFont }
          : { ...axis, ...filtered, label: figure.unit, labelSize: 18, labelFont: FONT, labelGap: 0, size: 50, values: (u, all) => all.map((v) => (v === null ? "" : readable(v))) },
      ],
      hooks: {
        drawClear: [(u) => this.paintBelow(u)],
        draw: [(u) => this.paintMarks(u)],
        setSelect: [(u) => this.select(u)],
        setCursor: [(u) => this.read(u)],
      },
    };
    this.plot = new uPlot(options, this.data, this.box);
    this.legend = rows.length ? element("div") : legendOf(figure.lines, (k, on) => {
      if (on) this.hidden.delete(k); else this.hidden.add(k);
      this.plot.setSeries(k + 1, { show: on });
    });
    this.box.before(this.legend);
    this.plot.over.append(this.hover);
    this.rescale();
  }

  /** Draw newer data of the same figure (live view). */
  update(figure) {
    this.figure = figure;
    if (figure.lines.map((line) => line.name).join("\n") !== this.names || figure.rows.join() !== (this.rows ?? figure.rows.join())) {
      this.plot.destroy();
      this.legend.remove();
      this.build();
      paintLegends();
    } else {
      this.data = this.joined();
      this.plot.setData(this.data, false);
    }
    this.rows = figure.rows.join();
  }

  rescale() {
    const [min, max] = this.group.range || this.group.full();
    this.plot.setScale("x", { min, max: max > min ? max : min + 1 });
  }

  resize() {
    const width = this.box.clientWidth;
    if (width > 0 && width !== this.plot.width) this.plot.setSize({ width, height: this.height });
  }

  repaint() { this.plot.redraw(false, true); }

  /** Nearest index where a series has a value: lines have times of their own. */
  known(series, at) {
    const y = this.data[series];
    if (!y || series === 0 || (y[at] ?? null) !== null) return at;
    for (let k = 1; k < 200; k++) {
      if ((y[at - k] ?? null) !== null) return at - k;
      if ((y[at + k] ?? null) !== null) return at + k;
      if (y[at - k] === null || y[at + k] === null) return null;
    }
    return null;
  }

  select(u) {
    if (u.select.width > 4) {
      this.group.zoom([u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x")]);
    }
    u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
  }

  read(u) {
    const { left, top, idx } = u.cursor, mine = u.over.matches(":hover");
    this.hover.hidden = !(mine && left >= 0 && idx !== null && idx !== undefined);
    if (!mine) return;
    this.group.point(left >= 0 ? u.posToVal(left, "x") : null);
    if (this.hover.hidden) return;
    const t = u.posToVal(left, "x"), near = Math.abs(u.posToVal(left + 7, "x") - t);
    const parts = [element("b", {}, `${clock(t, near < 2)} min:s`)];
    if (!this.figure.rows.length) {
      this.figure.lines.forEach((line, k) => {
        const at = this.known(k + 1, idx), value = at === null ? null : this.data[k + 1][at];
        if (!line.name || this.hidden.has(k) || (value ?? null) === null) return;
        if (Math.abs(this.data[0][at] - t) > Math.max(3 * near, 2)) return;
        const dot = element("span", { style: `color:${colourOf(line)}` }, line.dots ? "● " : "▬ ");
        parts.push(element("div", {}, dot, `${line.name}: ${readable(value)} ${this.figure.unit}`));
      });
    }
    for (const [at, text] of this.figure.marks.filter((mark) => Math.abs(mark[0] - t) <= near).slice(0, 4)) {
      parts.push(element("i", {}, `▲ ${clock(at)} ${text}`));
    }
    this.hover.replaceChildren(...parts);
    const right = left > u.over.clientWidth / 2;
    this.hover.style.left = right ? "auto" : `${left + 14}px`;
    this.hover.style.right = right ? `${u.over.clientWidth - left + 14}px` : "auto";
    this.hover.style.top = `${Math.max(0, Math.min(top, u.over.clientHeight - 40))}px`;
  }

  paintBelow(u) {
    const { left, top, width, height } = u.bbox, ctx = u.ctx;
    ctx.save();
    ctx.beginPath(); ctx.rect(left, top, width, height); ctx.clip();
    ctx.fillStyle = css("--shade");
    for (const [from, to] of this.figure.spans) {
      const a = u.valToPos(from, "x", true);
      ctx.fillRect(a, top, u.valToPos(to, "x", true) - a, height);
    }
    if (this.figure.level !== null) {
      const at = u.valToPos(this.figure.level, "y", true);
      ctx.strokeStyle = css("--ink"); ctx.setLineDash([2, 4]); ctx.lineWidth = devicePixelRatio;
      ctx.beginPath(); ctx.moveTo(left, at); ctx.lineTo(left + width, at); ctx.stroke();
    }
    ctx.restore();
  }

  paintMarks(u) {
    const { left, top, width, height } = u.bbox, ctx = u.ctx, r = 4 * devicePixelRatio;
    ctx.save();
    ctx.beginPath(); ctx.rect(left - r, top, width + 2 * r, height); ctx.clip();
    for (const [t, , warning] of this.figure.marks) {
      const x = u.valToPos(t, "x", true), base = top + height;
      ctx.fillStyle = css(warning ? "--fault" : "--soft");
      ctx.beginPath(); ctx.moveTo(x - r, base); ctx.lineTo(x + r, base); ctx.lineTo(x, base - 2 * r); ctx.fill();
    }
    ctx.restore();
  }
}

/** Map in metres east and north. Drag to move, wheel with Ctrl (or after a click) to zoom, two fingers on a screen. */
class Plan {
  constructor(box, figure, group, height) {
    Object.assign(this, { box, group, figure, hidden: new Set(), time: null, free: false, near: false });
    box.classList.add("map");
    box.style.height = height || `${Math.round(Math.min(620, Math.max(320, box.clientWidth * 0.62)))}px`;
    this.canvas = element("canvas", { tabindex: "0", role: "img", "aria-label": "map of the flight" });
    this.hover = element("div", { class: "hover", hidden: "" });
    const button = (text, title, act) => element("button", { type: "button", title, "aria-label": title, on: { click: act } }, text);
    box.append(this.canvas, this.hover, element("div", { class: "buttons" },
      button("+", "zoom in", () => this.scale(1.6)), button("−", "zoom out", () => this.scale(1 / 1.6)),
      button("⤢", "show all tracks", () => this.show(false)),
      ...(figure.near === undefined ? [] : [button("◎", "follow the aircraft", () => this.show(true))])));
    this.legendOf();
    group.maps.push(this);
    this.listen();
    new ResizeObserver(() => { if (!this.free) this.fit(); this.paint(); }).observe(this.canvas);
    this.fit();
    this.paint();
  }

  legendOf() {
    this.legend?.remove();
    this.names = this.figure.lines.map((line) => line.name).join("\n");
    this.hidden.clear();
    this.legend = legendOf(this.figure.lines, (k, on) => {
      if (on) this.hidden.delete(k); else this.hidden.add(k);
      this.paint();
    });
    this.box.before(this.legend);
  }

  update(figure) {
    this.figure = figure;
    if (figure.lines.map((line) => line.name).join("\n") !== this.names) { this.legendOf(); paintLegends(); }
    if (!this.free) this.fit();
    this.paint();
  }

  /** Show all tracks, or what is near the aircraft, and keep doing so. */
  show(near) { this.free = false; this.near = near; this.fit(); this.paint(); }

  get width() { return this.canvas.clientWidth || 300; }
  get height() { return this.canvas.clientHeight || 300; }

  fit() {
    const [x0, x1, y0, y1] = (this.near && this.figure.near) || this.figure.frame || [-100, 100, -100, 100];
    this.view = { x: (x0 + x1) / 2, y: (y0 + y1) / 2, k: Math.min(this.width / (x1 - x0), this.height / (y1 - y0)) };
  }

  scale(factor, px = this.width / 2, py = this.height / 2) {
    const [x, y] = this.world(px, py);
    this.view.k = Math.min(100, Math.max(1e-5, this.view.k * factor));
    this.view.x = x - (px - this.width / 2) / this.view.k;
    this.view.y = y + (py - this.height / 2) / this.view.k;
    this.free = true;
    this.paint();
  }

  world(px, py) { return [this.view.x + (px - this.width / 2) / this.view.k, this.view.y - (py - this.height / 2) / this.view.k]; }
  pixel(x, y) { return [this.width / 2 + (x - this.view.x) * this.view.k, this.height / 2 - (y - this.view.y) * this.view.k]; }

  listen() {
    const fingers = new Map(), at = (event) => [event.offsetX, event.offsetY];
    this.canvas.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && document.activeElement !== this.canvas) return;
      event.preventDefault();
      this.scale(Math.exp(-event.deltaY / 300), ...at(event));
    }, { passive: false });
    this.canvas.addEventListener("pointerdown", (event) => {
      this.canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, at(event));
    });
    this.canvas.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId), now = at(event);
      if (!before) return this.read(...now);
      const others = [...fingers].filter(([id]) => id !== event.pointerId);
      if (others.length) {
        const o = others[0][1], size = (p) => Math.hypot(p[0] - o[0], p[1] - o[1]) || 1;
        this.scale(size(now) / size(before), ...o);
      } else {
        this.view.x -= (now[0] - before[0]) / this.view.k;
        this.view.y += (now[1] - before[1]) / this.view.k;
        this.free = true;
        this.paint();
      }
      fingers.set(event.pointerId, now);
    });
    for (const name of ["pointerup", "pointercancel"]) this.canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
    this.canvas.addEventListener("pointerleave", () => { this.hover.hidden = true; });
  }

  /** Show name, time and coordinates of the point under the pointer. */
  read(px, py) {
    let best = null, near = 14;
    this.figure.lines.forEach((line, k) => {
      if (!line.t || this.hidden.has(k)) return;
      for (let i = 0; i < line.x.length; i++) {
        if (line.x[i] === null) continue;
        const [x, y] = this.pixel(line.x[i], line.y[i]), d = Math.hypot(x - px, y - py);
        if (d < near) { near = d; best = [line, i]; }
      }
    });
    this.hover.hidden = !best;
    if (!best) return;
    const [line, i] = best, [lat, lon] = this.figure.origin, [perNorth, perEast] = metresPerDegree(lat);
    const north = lat + line.y[i] / perNorth, east = lon + line.x[i] / perEast;
    this.hover.replaceChildren(element("b", {}, line.name), `${clock(line.t[i], true)} min:s`, element("i", {}, `${north.toFixed(5)}°, ${east.toFixed(5)}°`));
    this.hover.style.left = `${Math.min(px + 14, this.width - 170)}px`;
    this.hover.style.top = `${Math.max(4, py - 60)}px`;
  }

  mark(t) { this.time = t; this.paint(); }
  repaint() { this.paint(); }

  paint() {
    const ratio = devicePixelRatio || 1, { width, height, canvas } = this, ctx = canvas.getContext("2d");
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio);
    }
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.clearRect(0, 0, width, height);
    ctx.fillStyle = css("--paper"); ctx.fillRect(0, 0, width, height);
    ctx.font = FONT; ctx.lineJoin = "round";
    this.grid(ctx);
    this.figure.lines.forEach((line, k) => { if (!this.hidden.has(k)) this.line(ctx, line); });
    for (const place of this.figure.places) this.place(ctx, ...place);
    if (this.figure.aircraft) this.aircraft(ctx, ...this.figure.aircraft);
    if (this.time !== null) this.cross(ctx);
    this.furniture(ctx);
  }

  step() {
    const raw = 90 / this.view.k, power = 10 ** Math.floor(Math.log10(raw));
    return power * [1, 2, 5, 10].find((n) => n * power >= raw);
  }

  grid(ctx) {
    const step = this.step(), [x0, y1] = this.world(0, 0), [x1, y0] = this.world(this.width, this.height);
    ctx.strokeStyle = css("--grid"); ctx.lineWidth = 1;
    ctx.beginPath();
    for (let x = Math.ceil(x0 / step) * step; x <= x1; x += step) { const [p] = this.pixel(x, 0); ctx.moveTo(p, 0); ctx.lineTo(p, this.height); }
    for (let y = Math.ceil(y0 / step) * step; y <= y1; y += step) { const [, p] = this.pixel(0, y); ctx.moveTo(0, p); ctx.lineTo(this.width, p); }
    ctx.stroke();
  }

  line(ctx, line) {
    ctx.strokeStyle = ctx.fillStyle = colourOf(line);
    ctx.lineWidth = line.width;
    ctx.setLineDash(line.dash ? [6, 4] : []);
    ctx.beginPath();
    let open = false;
    for (let i = 0; i < line.x.length; i++) {
      if (line.x[i] === null || line.y[i] === null) { open = false; continue; }
      const [x, y] = this.pixel(line.x[i], line.y[i]);
      if (line.dots) ctx.rect(x - 1.5, y - 1.5, 3, 3);
      else if (open) ctx.lineTo(x, y);
      else { ctx.moveTo(x, y); open = true; }
    }
    if (line.dots) { ctx.globalAlpha = 0.75; ctx.fill(); ctx.globalAlpha = 1; } else ctx.stroke();
    ctx.setLineDash([]);
  }

  text(ctx, text, x, y) {
    ctx.lineWidth = 3; ctx.strokeStyle = css("--paper"); ctx.strokeText(text, x, y);
    ctx.fillStyle = css("--ink"); ctx.fillText(text, x, y);
  }

  /** A beacon; one outside the view is shown at the edge, with its distance from the centre. */
  place(ctx, name, x, y) {
    let [px, py] = this.pixel(x, y);
    const inside = px > 8 && py > 8 && px < this.width - 8 && py < this.height - 8;
    ctx.fillStyle = css("--good");
    ctx.beginPath();
    if (inside) {
      ctx.moveTo(px, py - 8); ctx.lineTo(px + 7, py + 5); ctx.lineTo(px - 7, py + 5); ctx.fill();
      const room = ctx.measureText(name).width;
      this.text(ctx, name, px + 10 + room < this.width - 50 ? px + 10 : px - 10 - room, py + 4);  // clear of the edge and the buttons
      return;
    }
    const dx = px - this.width / 2, dy = py - this.height / 2;
    const side = dx > 0 ? 60 : 22;  // right of it are the buttons
    const k = Math.min((this.width / 2 - side) / Math.abs(dx || 1e-9), (this.height / 2 - 22) / Math.abs(dy || 1e-9));
    px = this.width / 2 + dx * k; py = this.height / 2 + dy * k;
    const angle = Math.atan2(dy, dx), at = (r, a) => [px + r * Math.cos(angle + a), py + r * Math.sin(angle + a)];
    ctx.moveTo(...at(11, 0)); ctx.lineTo(...at(8, 2.4)); ctx.lineTo(...at(8, -2.4)); ctx.fill();
    const km = Math.hypot(x - this.view.x, y - this.view.y) / 1000, label = `${name}, ${km >= 10 ? km.toFixed(0) : km.toFixed(1)} km`;
    const room = ctx.measureText(label).width;
    this.text(ctx, label, Math.min(Math.max(4, px - room / 2), this.width - room - 50), py > this.height / 2 ? py - 14 : py + 24);
  }

  aircraft(ctx, x, y, heading) {
    const [px, py] = this.pixel(x, y);
    ctx.save();
    ctx.translate(px, py); ctx.rotate(heading);
    ctx.beginPath(); ctx.moveTo(0, -11); ctx.lineTo(8, 9); ctx.lineTo(0, 4); ctx.lineTo(-8, 9); ctx.closePath();
    ctx.lineWidth = 3; ctx.strokeStyle = css("--paper"); ctx.stroke();
    ctx.fillStyle = css("--ink"); ctx.fill();
    ctx.restore();
  }

  /** Ring at the point of each track at the time under the cursor of a chart. */
  cross(ctx) {
    ctx.strokeStyle = css("--ink"); ctx.lineWidth = 2;
    this.figure.lines.forEach((line, k) => {
      if (!line.t?.length || line.dots || this.hidden.has(k)) return;
      const i = nearest(line.t, this.time);
      if (line.x[i] === null || Math.abs(line.t[i] - this.time) > 5) return;
      const [x, y] = this.pixel(line.x[i], line.y[i]);
      ctx.beginPath(); ctx.arc(x, y, 6, 0, 7); ctx.stroke();
    });
  }

  furniture(ctx) {
    const step = this.step(), size = step * this.view.k, y = this.height - 14, ink = css("--ink");
    ctx.strokeStyle = ctx.fillStyle = ink; ctx.lineWidth = 2;
    ctx.beginPath(); ctx.moveTo(14, y - 5); ctx.lineTo(14, y); ctx.lineTo(14 + size, y); ctx.lineTo(14 + size, y - 5); ctx.stroke();
    this.text(ctx, step >= 1000 ? `${step / 1000} km` : `${readable(step)} m`, 18, y - 7);
    const nx = this.width - 22;
    ctx.fillStyle = ink;
    ctx.beginPath(); ctx.moveTo(nx, 10); ctx.lineTo(nx + 6, 28); ctx.lineTo(nx, 23); ctx.lineTo(nx - 6, 28); ctx.fill();
    this.text(ctx, "N", nx - 4, 42);
  }
}

/** Draw all again in the colours in force. */
function repaintAll(groups) {
  paintLegends();
  for (const group of groups) for (const item of [...group.charts, ...group.maps]) item.repaint();
}
