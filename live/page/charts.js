// Three small charts: errors over time (logarithmic), curvature along the arm, latency of every link.

import { begin, onAxis, palette, polyline, roundDown, roundStep } from "./plane.js";

const MOST = 900;
const LEAST_MM = 1e-3;
const LEFT = 40, UNDER = 18;

// Running curves of two errors in millimetres over the arm's time; thinned when there are too many points.
export class ErrorChart {
  constructor(canvas) {
    this.canvas = canvas;
    this.points = [];
    this.stride = 1;
    this.count = 0;
  }

  forget() {
    this.points = [];
  }

  take(frame) {
    this.count += 1;
    if (this.count % this.stride) return;
    const estimate = frame.estimation_error_m;
    this.points.push([frame.time_s, 1e3 * frame.tip_error_m, estimate === undefined ? null : 1e3 * estimate]);
    if (this.points.length >= MOST) {
      this.points = this.points.filter((_, i) => i % 2 === 0);
      this.stride *= 2;
    }
  }

  draw() {
    const canvas = begin(this.canvas);
    if (canvas === null) return;
    const { g, width, height } = canvas;
    const shade = palette();
    const floor = height - UNDER;
    const points = this.points;
    const from = points.length ? points[0][0] : 0;
    const until = points.length > 1 ? points.at(-1)[0] : from + 1;
    const values = points.flatMap(([, ...two]) => two).filter((v) => v !== null).map((v) => Math.max(v, LEAST_MM));
    const low = Math.floor(Math.log10(values.length ? Math.min(...values) : 0.1));
    const high = Math.max(low + 1, Math.ceil(Math.log10(values.length ? Math.max(...values) : 100)));
    const x = (t) => LEFT + ((width - LEFT - 8) * (t - from)) / (until - from || 1);
    const y = (v) => 6 + ((floor - 6) * (high - Math.log10(Math.max(v, LEAST_MM)))) / (high - low);
    g.strokeStyle = shade.grid;
    g.fillStyle = shade.soft;
    g.lineWidth = 1;
    g.textAlign = "right";
    g.textBaseline = "middle";
    for (let power = low; power <= high; power += 1) {
      const at = Math.round(y(10 ** power)) + 0.5;
      polyline(g, [LEFT, at, width, at]);
      g.stroke();
      g.fillText(power >= 0 ? String(10 ** power) : (10 ** power).toFixed(-power), LEFT - 6, Math.max(6, at));
    }
    timeAxis(g, from, until, x, floor, width);
    for (const [at, tone] of [[1, shade.vermillion], [2, shade.blue]]) {
      const flat = points.filter((p) => p[at] !== null).flatMap((p) => [x(p[0]), y(p[at])]);
      g.strokeStyle = tone;
      g.lineWidth = 1.8;
      polyline(g, flat);
      g.stroke();
    }
  }
}

function timeAxis(g, from, until, x, floor, width) {
  const step = roundStep(until - from || 1, width / 70);
  g.textAlign = "center";
  g.textBaseline = "top";
  for (let i = Math.ceil(from / step - 1e-9); i * step <= until + 1e-9; i += 1) {
    const at = x(i * step);
    if (at < width - 24) g.fillText(onAxis(i * step, step), at, floor + 5);
  }
  g.textAlign = "right";
  g.fillText("s", width, floor + 5);
}

// Curvature in 1/m at the nodes' inner faces.
export class CurvatureChart {
  constructor(canvas, facts) {
    this.canvas = canvas;
    this.at = facts.faces_m.slice(0, -1);
    this.length = facts.length_m;
    this.low = -1;
    this.high = 1;
  }

  draw(frame) {
    const canvas = begin(this.canvas);
    if (canvas === null || frame === null) return;
    const { g, width, height } = canvas;
    const shade = palette();
    const floor = height - UNDER;
    for (const value of [...frame.curvature, ...frame.curvature_estimate.filter((v) => v !== null)]) {
      this.low = Math.min(this.low, value);
      this.high = Math.max(this.high, value);
    }
    const step = roundStep(this.high - this.low, floor / 34);
    const low = Math.floor(this.low / step) * step, high = Math.ceil(this.high / step) * step;
    const x = (s) => LEFT + ((width - LEFT - 10) * s) / this.length;
    const y = (v) => 6 + ((floor - 6) * (high - v)) / (high - low);
    g.fillStyle = shade.soft;
    g.lineWidth = 1;
    g.textAlign = "right";
    g.textBaseline = "middle";
    for (let i = Math.round(low / step); i <= Math.round(high / step); i += 1) {
      const at = Math.round(y(i * step)) + 0.5;
      g.strokeStyle = i === 0 ? shade.trail : shade.grid;
      polyline(g, [LEFT, at, width, at]);
      g.stroke();
      g.fillText(onAxis(i * step, step), LEFT - 6, Math.max(6, at));
    }
    g.textBaseline = "top";
    g.textAlign = "center";
    const part = roundStep(this.length, width / 70);
    for (let s = 0; s <= this.length * 0.95; s += part) g.fillText(onAxis(s, part), x(s), floor + 5);
    g.textAlign = "right";
    g.fillText("m", width, floor + 5);
    g.strokeStyle = shade.blue;
    g.lineWidth = 1.8;
    polyline(g, frame.curvature.flatMap((v, i) => [x(this.at[i]), y(v)]));
    g.stroke();
    g.fillStyle = shade.vermillion;
    const size = this.at.length > 40 ? 1.8 : 3;
    frame.curvature_estimate.forEach((v, i) => {
      if (v === null) return;
      g.beginPath();
      g.arc(x(this.at[i]), y(v), size, 0, 2 * Math.PI);
      g.fill();
    });
  }
}

// A bar up and a bar down for every link: medians, with a mark at the longest.
export class LinkChart {
  constructor(canvas, read, facts) {
    this.canvas = canvas;
    this.read = read;
    this.count = facts.nodes - 1;
    this.shown = null;
    this.links = null;
    canvas.addEventListener("pointermove", (event) => this.point(event.offsetX));
    canvas.addEventListener("pointerleave", () => this.choose(null));
    canvas.addEventListener("blur", () => this.choose(null));
    canvas.addEventListener("keydown", (event) => {
      const move = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (move === undefined) return;
      event.preventDefault();
      const at = this.shown === null ? (move > 0 ? 0 : this.count - 1) : this.shown + move;
      this.choose(Math.min(this.count - 1, Math.max(0, at)));
    });
  }

  point(offset) {
    const at = Math.floor(((offset - LEFT) / (this.canvas.clientWidth - LEFT)) * this.count);
    this.choose(at >= 0 && at < this.count ? at : null);
  }

  choose(link) {
    this.shown = link;
    this.draw(this.links);
  }

  draw(links) {
    const canvas = begin(this.canvas);
    if (canvas === null || links === null) return;
    this.links = links;
    const { g, width, height } = canvas;
    const shade = palette();
    const known = [...links.forward_us, ...links.backward_us].filter((v) => v !== null);
    const sorted = [...known].sort((a, b) => a - b);
    const top = sorted.length ? Math.max(20, sorted.at(-1)) * 1.1 : 100;
    const step = roundDown(top);
    const y = (v) => height / 2 - ((height / 2 - 5) * v) / top;
    g.textAlign = "right";
    g.textBaseline = "middle";
    g.lineWidth = 1;
    for (let i = -Math.floor(top / step); i <= Math.floor(top / step); i += 1) {
      const at = Math.round(y(i * step)) + 0.5;
      g.strokeStyle = i === 0 ? shade.trail : shade.grid;
      polyline(g, [LEFT, at, width, at]);
      g.stroke();
      g.fillStyle = shade.soft;
      g.fillText(onAxis(Math.abs(i * step), step), LEFT - 6, at);
    }
    const wide = (width - LEFT) / this.count;
    const bar = Math.max(1, Math.min(26, wide - Math.min(3, 0.25 * wide)));
    for (let i = 0; i < this.count; i += 1) {
      const x = LEFT + wide * (i + 0.5) - bar / 2;
      if (i === this.shown) {
        g.fillStyle = shade.grid;
        g.fillRect(LEFT + wide * i, 0, wide, height);
      }
      for (const [list, tone, sign] of [[links.forward_us, shade.blue, 1], [links.backward_us, shade.orange, -1]]) {
        const value = list[i];
        if (value === null) continue;
        g.fillStyle = tone;
        g.fillRect(x, Math.min(y(0), y(sign * value)), bar, Math.abs(y(sign * value) - y(0)));
      }
    }
    this.say(links);
  }

  say(links) {
    const parts = [];
    const tell = (from, to, us, most) => `${from} \u2192 ${to}: ${us === null ? "not measured" : `${us} \u00b5s (longest ${most})`}`;
    const i = this.shown;
    if (i !== null) {
      parts.push(tell(i, i + 1, links.forward_us[i], links.forward_most_us[i]));
      parts.push(tell(i + 1, i, links.backward_us[i], links.backward_most_us[i]));
    } else {
      const all = [
        ...links.forward_us.map((us, j) => [us, j, j + 1, links.forward_most_us[j]]),
        ...links.backward_us.map((us, j) => [us, j + 1, j, links.backward_most_us[j]]),
      ].filter(([us]) => us !== null);
      if (all.length) {
        const [us, from, to, most] = all.reduce((a, b) => (b[0] > a[0] ? b : a));
        parts.push(`slowest: ${tell(from, to, us, most)}`, `median of the last ${links.ticks} ticks`);
      } else {
        parts.push("no link between processes of one clock has been measured");
      }
    }
    const text = parts.join(", ");
    if (this.read.textContent !== text) this.read.textContent = text;
  }
}
