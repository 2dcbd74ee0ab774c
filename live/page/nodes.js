// Three cells a node, three different things: it lives, its rows come in time, and nothing of it is wrong.

const ROWS = [
  ["alive", "alive"],
  ["on_time", "on time"],
  ["valid", "valid"],
];
const MANY = 30;

export class NodeCells {
  constructor(box, read, facts) {
    this.read = read;
    this.count = facts.nodes;
    this.alive = [];
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
    this.draw();
  }

  takeFrame(frame) {
    this.states = { ...frame.nodes, newest: Math.max(...frame.nodes.tick) };
    this.draw();
  }

  draw() {
    const states = this.states;
    for (let i = 0; i < this.count; i += 1) {
      mark(this.cells.alive[i], this.alive.length ? (this.alive[i] ? "good" : "bad") : "");
      if (states === null) continue;
      const silent = states.age_s[i] === null;
      mark(this.cells.on_time[i], silent ? "" : states.on_time[i] ? "good" : "fair");
      mark(this.cells.valid[i], states.valid[i] ? (silent ? "" : "good") : states.rejected[i] ? "bad" : "fair");
    }
    this.say();
  }

  say() {
    let text = "";
    const states = this.states;
    if (this.shown === null) {
      const living = this.alive.filter(Boolean).length;
      text = `${living} of ${this.count} alive`;
      if (states !== null) {
        const count = (list) => list.filter(Boolean).length;
        text += `, ${count(states.on_time)} on time, ${count(states.valid)} valid`;
      }
    } else if (states !== null) {
      const i = this.shown;
      const age = states.age_s[i] === null ? "no rows yet" : `last row ${states.age_s[i].toFixed(2)} s ago`;
      text = `node ${i}: ${this.alive[i] ? "alive" : "no token"}, at tick ${states.tick[i]}, ${age}, `
        + `${states.rejected[i]} rejected, ${states.late[i]} late`;
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
