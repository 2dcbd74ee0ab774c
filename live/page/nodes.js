// Three cells a node, three different things, as the plant sees them: it lives, its commands come in time, and
// nothing of it is wrong.

const ROWS = [
  ["alive", "alive"],
  ["on_time", "on time"],
  ["valid", "valid"],
];
const MANY = 30;
const FLAGS = [
  [1, "bridges the forward sum"],
  [2, "bridges the backward sum"],
  [4, "held its command"],
  [8, "has a forward sum that is not of the whole arm"],
  [16, "held its measurement"],
  [32, "has just joined"],
];

export class NodeCells {
  constructor(box, read, facts) {
    this.read = read;
    this.count = facts.nodes;
    this.alive = []; // by their tokens
    this.final = false;
    this.states = null;
    this.shown = null;
    this.cells = {};
    box.classList.toggle("many", this.count > MANY);
    box.style.gridTemplateColumns = `auto repeat(${this.count}, minmax(2px, 1fr))`;
    box.append(label(""));
    const every = this.count <= MANY ? 1 : 10 ** Math.ceil(Math.log10(this.count / 12));
    for (let i = 0; i < this.count; i += 1) {
      const head = label(i % every ? "" : String(i));
      head.className = "number";
      box.append(head);
    }
    for (const [name, text] of ROWS) {
      box.append(label(text));
      this.cells[name] = [];
      for (let i = 0; i < this.count; i += 1) {
        const cell = document.createElement("i");
        cell.dataset.node = i;
        cell.dataset.row = name;
        this.cells[name].push(cell);
        box.append(cell);
      }
    }
    box.addEventListener("pointerover", (event) => this.choose(event.target.dataset.node));
    box.addEventListener("pointerleave", () => this.choose(undefined));
  }

  choose(node) {
    this.shown = node === undefined ? null : Number(node);
    this.say();
  }

  takeState(state) {
    this.alive = state.alive;
    this.final = state.final;
    this.draw();
  }

  takeFrame(frame) {
    this.states = { ...frame.nodes, newest: Math.max(...frame.nodes.tick) };
    this.draw();
  }

  draw() {
    const states = this.states;
    for (let i = 0; i < this.count; i += 1) {
      mark(this.cells.alive[i], this.alive.length ? (this.lives(i) ? "good" : "bad") : "");
      if (states === null) continue;
      const silent = states.age_s[i] === null;
      mark(this.cells.on_time[i], silent ? "" : states.on_time[i] ? "good" : "fair");
      mark(this.cells.valid[i], states.valid[i] ? (silent ? "" : "good") : states.rejected[i] ? "bad" : "fair");
    }
    this.say();
  }

  // At the end tokens alone tell, and the launcher; until then also the plant, in whose rows a short absence is seen.
  lives(i) {
    return this.alive[i] && (this.final || this.states === null || this.states.alive[i]);
  }

  say() {
    let text = "";
    const states = this.states;
    if (this.shown === null) {
      const living = this.alive.filter((_, i) => this.lives(i)).length;
      text = `${living} of ${this.count} alive`;
      if (states !== null) {
        const count = (list) => list.filter(Boolean).length;
        text += `, ${count(states.on_time)} on time, ${count(states.valid)} valid`;
        const bridging = states.flags.filter((flags) => flags & 3).length;
        if (bridging > 0) text += `; ${bridging} bridge sums`;
        const out = this.alive.map((_, i) => i).filter((i) => !this.lives(i) && !this.final);
        if (out.length > 0) text += `; out: ${out.slice(0, 6).join(", ")}${out.length > 6 ? ", \u2026" : ""}`;
      }
    } else if (states !== null) {
      const i = this.shown;
      const age = states.age_s[i] === null ? "no rows yet" : `last row ${states.age_s[i].toFixed(2)} s ago`;
      text = `node ${i}: ${this.lives(i) ? "alive" : this.alive[i] ? "was out" : "no token"}, at tick ${states.tick[i]}, ${age}, `
        + `${states.rejected[i]} rejected, ${states.late[i]} late, ${states.bridged[i]} bridged`;
      for (const [flag, words] of FLAGS) if (states.flags[i] & flag) text += `, ${words}`;
    }
    if (this.read.textContent !== text) this.read.textContent = text;
  }
}

function label(text) {
  const span = document.createElement("span");
  span.textContent = text;
  return span;
}

function mark(cell, name) {
  if (cell.className !== name) cell.className = name;
}
