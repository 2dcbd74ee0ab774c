// The live page: facts of the run once, then events; everything that is drawn comes from the newest of each kind.

import { ArmView, between } from "./arm.js";
import { CurvatureChart, ErrorChart, LinkChart } from "./charts.js";
import { NodeCells } from "./nodes.js";
import { forgetPalette, goalColour } from "./plane.js";

const WORDS = {
  waiting: "waiting for the nodes",
  running: "running",
  ending: "ending",
  finished: "finished",
  interrupted: "interrupted",
  safety_stop: "safety stop",
  failed: "failed",
};
const SLOW_MS = 150; // frames that come more slowly are joined by straight lines
const FLUENT_MS = 50;
const SILENCE_MS = 4000;

const at = (id) => document.getElementById(id);
const put = (id, text) => {
  if (at(id).textContent !== text) at(id).textContent = text;
};

class Page {
  constructor(facts) {
    this.facts = facts;
    this.arm = new ArmView(at("arm"), facts);
    this.errors = new ErrorChart(at("errors"));
    this.curvature = new CurvatureChart(at("curvature"), facts);
    this.links = new LinkChart(at("links"), at("links-read"), facts);
    this.nodes = new NodeCells(at("nodes"), at("nodes-read"), facts);
    this.before = null;
    this.frame = null;
    this.cameAt = 0;
    this.gap = 100;
    this.timer = 0;
    const pace = facts.period_s === null ? "lock-step" : `real time, a tick every ${number(facts.period_s)} s`;
    put("run", `${facts.replay ? "replay of " : ""}${facts.run_id} \u00b7 ${facts.scenario} \u00b7 ${facts.nodes} nodes \u00b7 tick ${number(facts.tick_s)} s \u00b7 ${pace} \u00b7 gains ${facts.gains_sha256.slice(0, 12)}`);
    put("ticks", `of ${facts.ticks}`);
    put("due", facts.period_s === null ? "lock-step" : `${number(1 / facts.period_s)} due`);
    this.drawAll();
  }

  takeFrame(frame) {
    const now = performance.now();
    const again = this.frame !== null && frame.tick === this.frame.tick;
    if (!again) {
      if (this.frame !== null) this.gap = 0.7 * this.gap + 0.3 * Math.min(2000, now - this.cameAt);
      const restarted = this.frame !== null && frame.tick < this.frame.tick; // a recording that is played in a loop
      if (restarted) {
        this.arm.forget();
        this.errors.forget();
      }
      this.before = restarted ? null : this.frame;
      this.cameAt = now;
      this.arm.take(frame);
      this.errors.take(frame);
    }
    this.frame = frame;
    this.nodes.takeFrame(frame);
    this.figures(frame);
    this.drawAll();
  }

  // What moves between two slow frames.
  drawArm() {
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    const share = still || this.gap < SLOW_MS ? 1 : (performance.now() - this.cameAt) / this.gap;
    this.arm.draw(this.frame === null ? null : between(this.before, this.frame, share));
    clearTimeout(this.timer);
    if (share < 1) this.timer = setTimeout(() => this.drawArm(), FLUENT_MS);
  }

  drawAll() {
    if (document.hidden) return;
    this.drawArm();
    this.errors.draw();
    this.curvature.draw(this.frame);
    this.links.draw(this.frame === null ? null : this.frame.links);
  }

  figures(frame) {
    const index = frame.setpoint ?? this.facts.setpoint;
    const name = this.facts.setpoint_names[index];
    if (at("setpoint").dataset.name !== name) {
      const patch = document.createElement("i");
      patch.style.background = goalColour(index);
      at("setpoint").replaceChildren(patch, document.createTextNode(name));
      at("setpoint").dataset.name = name;
      document.documentElement.style.setProperty("--active", goalColour(index));
    }
    put("tick", String(frame.tick));
    put("rate", frame.ticks_per_s === null ? "\u2013" : number(frame.ticks_per_s));
    put("time", seconds(frame.time_s));
    if (frame.wall_s !== undefined) {
      put("wall", seconds(frame.wall_s));
      put("ratio", frame.wall_s > 0.5 ? `${number(frame.time_s / frame.wall_s)} x wall clock` : "");
    }
    put("tip-error", millimetres(frame.tip_error_m));
    put("estimation-error", millimetres(frame.estimation_error_m));
    put("energy", frame.estimation_error === undefined ? "rms along the arm" : `${number(100 * frame.estimation_error)} % in energy`);
    put("p50", frame.sweep_p50_ms === null ? "\u2013" : `${number(frame.sweep_p50_ms)} ms`);
    put("p99", frame.sweep_p99_ms === null ? "\u2013" : `${number(frame.sweep_p99_ms)} ms`);
    put("guard", frame.passive ? "PASSIVE: static loads only" : "whose gains run");
    at("guard").classList.toggle("passive", frame.passive);
    put("late", String(frame.late_ticks));
    put("late-of", `of ${frame.ticks_seen} watched`);
    at("late-box").classList.toggle("some", frame.late_ticks > 0);
  }

  takeState(state) {
    this.nodes.takeState(state);
  }
}

function number(value) {
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1000) return value.toFixed(0);
  return String(Number(value.toPrecision(3)));
}

function seconds(value) {
  return `${value < 100 ? value.toFixed(1) : value.toFixed(0)} s`;
}

function millimetres(metres) {
  return metres === undefined ? "\u2013" : `${number(1e3 * metres)} mm`;
}

function show(name, text, banner) {
  document.body.className = name;
  put("state", text);
  at("banner").hidden = banner === "";
  put("banner", banner);
}

const LOST = "connection lost: the stream has ended without a word about the run's end; what is shown is the last that came";

// The stream, and what is known of it; the browser itself asks again when it breaks.
function follow(page, facts) {
  const source = new EventSource("events");
  let last = null;
  let heard = performance.now();
  let over = false;
  const tell = () => {
    if (last === null) return;
    const banner = last.message || (last.final ? "the run is over" : "");
    show(last.state, WORDS[last.state] ?? last.state, last.final || last.message ? banner : "");
  };
  source.addEventListener("state", (event) => {
    heard = performance.now();
    last = JSON.parse(event.data);
    if (last.run_id !== facts.run_id) {
      location.reload(); // another run has taken the port
      return;
    }
    page.takeState(last);
    tell();
    if (last.final) {
      over = true;
      source.close();
    }
  });
  source.addEventListener("frame", (event) => {
    if (performance.now() - heard > SILENCE_MS) tell();
    heard = performance.now();
    page.takeFrame(JSON.parse(event.data));
  });
  source.addEventListener("open", () => {
    heard = performance.now();
    tell();
  });
  setInterval(() => {
    if (over || last === null || last.state !== "running" || performance.now() - heard < SILENCE_MS) return;
    show("lost", "no news", "nothing has come for some seconds, though the run should go on; what is shown is the last that came");
  }, 1000);
  source.addEventListener("error", () => {
    if (!over) show("lost", "connection lost", source.readyState === EventSource.CLOSED
      ? "the stream was refused: too many pages are open, or the run is over" : LOST);
  });
}

async function begin() {
  let facts;
  try {
    const answer = await fetch("run.json");
    if (!answer.ok) throw new Error(String(answer.status));
    facts = await answer.json();
  } catch {
    show("lost", "no answer", "the run's facts did not come; reload the page while a run goes on");
    return;
  }
  const page = new Page(facts);
  new ResizeObserver(() => page.drawAll()).observe(document.querySelector("main"));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    forgetPalette();
    delete at("setpoint").dataset.name;
    if (page.frame !== null) page.figures(page.frame);
    page.drawAll();
  });
  document.addEventListener("visibilitychange", () => page.drawAll());
  follow(page, facts);
}

begin();
