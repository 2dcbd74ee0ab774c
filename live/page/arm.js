// The arm in the plane, in metres: true and estimated, setpoints behind it, the tip's reference and path.

import { begin, goalColour, onAxis, palette, polyline, roundStep } from "./plane.js";

const TRAIL = 240;
const MARGIN = 0.07;

export class ArmView {
  constructor(canvas, facts) {
    this.canvas = canvas;
    this.facts = facts;
    this.trail = [];
    const length = facts.length_m;
    this.box = [-0.04 * length, 0, 0.3 * length, 0];
    for (const goal of facts.goals) goal.shape_m.forEach(([x, y]) => this.include(x, y));
  }

  include(x, y) {
    const box = this.box;
    box[0] = Math.min(box[0], x);
    box[1] = Math.min(box[1], y);
    box[2] = Math.max(box[2], x);
    box[3] = Math.max(box[3], y);
  }

  forget() {
    this.trail = [];
  }

  take(frame) {
    const shape = frame.shape;
    for (let i = 0; i < shape.length; i += 2) this.include(shape[i], shape[i + 1]);
    this.include(...frame.reference);
    this.trail.push(...frame.tip);
    if (this.trail.length > 2 * TRAIL) this.trail.splice(0, this.trail.length - 2 * TRAIL);
  }

  // frame: what is shown; its shape and joints may lie between those of two frames.
  draw(frame) {
    const canvas = begin(this.canvas);
    if (canvas === null) return;
    const { g, width, height } = canvas;
    const shade = palette();
    const to = this.fit(width, height);
    const map = (flat) => flat.map((value, i) => (i % 2 ? to.y(value) : to.x(value)));
    this.grid(g, width, height, to);
    for (const goal of this.facts.goals) this.goal(g, goal, map, to);
    if (frame === null) {
      this.root(g, to);
      return;
    }
    g.strokeStyle = shade.trail;
    g.lineWidth = 1.5;
    const trail = map(this.trail);
    for (let i = 2; i < trail.length; i += 2) {
      g.globalAlpha = 0.15 + 0.75 * (i / trail.length);
      polyline(g, trail.slice(i - 2, i + 2));
      g.stroke();
    }
    g.globalAlpha = 1;
    g.lineCap = "round";
    g.strokeStyle = goalColour(frame.setpoint ?? this.facts.setpoint);
    g.lineWidth = 7;
    polyline(g, map(frame.shape));
    g.stroke();
    g.lineCap = "butt";
    if (frame.joints !== null) this.estimate(g, map(frame.joints), frame.estimate_tick !== frame.tick);
    this.root(g, to);
    const [x, y] = frame.reference;
    g.strokeStyle = shade.panel;
    g.lineWidth = 4.5;
    g.beginPath();
    g.arc(to.x(x), to.y(y), 7, 0, 2 * Math.PI);
    g.stroke();
    g.strokeStyle = shade.ink;
    g.lineWidth = 2;
    g.stroke();
  }

  estimate(g, joints, old) {
    const shade = palette();
    g.globalAlpha = old ? 0.45 : 1;
    g.strokeStyle = shade.ink;
    g.lineWidth = 1.8;
    g.setLineDash([6, 4]);
    polyline(g, joints);
    g.stroke();
    g.setLineDash([]);
    const size = joints.length > 60 ? 1.4 : 2.6;
    g.fillStyle = shade.ink;
    for (let i = 2; i < joints.length; i += 2) {
      g.beginPath();
      g.arc(joints[i], joints[i + 1], size, 0, 2 * Math.PI);
      g.fill();
    }
    g.globalAlpha = 1;
  }

  root(g, to) {
    g.fillStyle = palette().root;
    g.fillRect(to.x(0) - 7, to.y(0) - 9, 7, 18);
  }

  goal(g, goal, map, to) {
    g.strokeStyle = g.fillStyle = goalColour(goal.setpoint);
    g.lineWidth = 1.3;
    g.globalAlpha = 0.75;
    g.setLineDash([5, 4]);
    polyline(g, map(goal.shape_m.flat()));
    g.stroke();
    g.setLineDash([]);
    g.globalAlpha = 1;
    const [x, y] = goal.shape_m.at(-1), reach = Math.hypot(x, y);
    g.font = `600 ${g.font}`;
    g.textAlign = "center";
    g.textBaseline = "middle";
    g.fillText(this.facts.setpoint_names[goal.setpoint], to.x(x) + (18 * x) / reach, to.y(y) - (18 * y) / reach);
    g.font = g.font.replace("600 ", "");
  }

  // One scale for both directions, everything that was seen in it.
  fit(width, height) {
    const [low, bottom, high, top] = this.box;
    const free = MARGIN * this.facts.length_m;
    const left = 34, under = 20, over = 12; // for numbers and for a setpoint's name
    const scale = Math.min(
      (width - left - over) / (high - low + 2 * free),
      (height - under - over) / (top - bottom + 2 * free),
    );
    const x0 = left + (width - left - over) / 2 - (scale * (low + high)) / 2;
    const y0 = over + (height - under - over) / 2 + (scale * (bottom + top)) / 2;
    return { scale, left, under, x: (x) => x0 + scale * x, y: (y) => y0 - scale * y, x0, y0 };
  }

  grid(g, width, height, to) {
    const shade = palette();
    const step = roundStep(width / to.scale, width / 55);
    g.lineWidth = 1;
    g.strokeStyle = shade.grid;
    g.fillStyle = shade.soft;
    const floor = height - to.under;
    g.textAlign = "center";
    g.textBaseline = "top";
    for (let i = Math.ceil((to.left - to.x0) / to.scale / step); ; i += 1) {
      const x = to.x(i * step);
      if (x > width) break;
      line(g, x, 0, x, floor);
      if (x < width - 30 && x > to.left + 8) g.fillText(onAxis(i * step, step), x, floor + 5);
    }
    g.textAlign = "right";
    g.textBaseline = "middle";
    for (let i = Math.ceil((to.y0 - floor) / to.scale / step); ; i += 1) {
      const y = to.y(i * step);
      if (y < 0) break;
      line(g, to.left, y, width, y);
      if (y > 6 && y < floor - 2) g.fillText(onAxis(i * step, step), to.left - 6, y);
    }
    g.textBaseline = "top";
    g.fillText("m", width, floor + 5);
  }
}

function line(g, x0, y0, x1, y1) {
  g.beginPath();
  g.moveTo(Math.round(x0) + 0.5, Math.round(y0) + 0.5);
  g.lineTo(Math.round(x1) + 0.5, Math.round(y1) + 0.5);
  g.stroke();
}

// Two frames mixed: what lies `share` of the way from `before` to `after`.
export function between(before, after, share) {
  if (before === null || share >= 1) return after;
  const mix = (a, b) => (a && b && a.length === b.length ? b.map((value, i) => a[i] + share * (value - a[i])) : b);
  return {
    ...after,
    shape: mix(before.shape, after.shape),
    joints: mix(before.joints, after.joints),
    reference: mix(before.reference, after.reference),
  };
}
