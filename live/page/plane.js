// Drawing helpers: a canvas in CSS pixels, the palette of the style sheet, round numbers for axes.

export const FONT = "11px system-ui, -apple-system, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif";
const GOALS = ["blue", "vermillion", "green", "purple", "sky", "orange"];
const NAMES = [...GOALS, "ink", "soft", "grid", "trail", "root", "panel", "edge", "none"];

let shades = null;

// The colours of the scheme that is on; looked up again when it changes.
export function palette() {
  if (shades === null) {
    const style = getComputedStyle(document.documentElement);
    shades = Object.fromEntries(NAMES.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
  }
  return shades;
}

export function forgetPalette() {
  shades = null;
}

// The colour of a setpoint by its place in the artefact; they repeat after six.
export function goalColour(index) {
  return palette()[GOALS[index % GOALS.length]];
}

// The context of a canvas, cleared and scaled to CSS pixels; null while it has no size.
export function begin(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const width = canvas.clientWidth, height = canvas.clientHeight;
  if (width < 20 || height < 20) return null;
  const wide = Math.round(width * ratio), tall = Math.round(height * ratio);
  if (canvas.width !== wide || canvas.height !== tall) {
    canvas.width = wide;
    canvas.height = tall;
  }
  const g = canvas.getContext("2d");
  g.setTransform(ratio, 0, 0, ratio, 0, 0);
  g.clearRect(0, 0, width, height);
  g.font = FONT;
  g.lineJoin = "round";
  return { g, width, height };
}

// A step of 1, 2 or 5 times a power of ten of which about `count` go into the span.
export function roundStep(span, count) {
  const raw = span / Math.max(1, count);
  const power = 10 ** Math.floor(Math.log10(raw));
  return power * [1, 2, 5, 10].find((one) => one * power >= raw * 0.999);
}

// The largest of 1, 2 or 5 times a power of ten that is not above a value.
export function roundDown(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * [5, 2, 1].find((one) => one * power <= value);
}

// A number as an axis has it: no more decimals than its step needs.
export function onAxis(value, step) {
  return value.toFixed(Math.max(0, -Math.floor(Math.log10(step) + 1e-9)));
}

export function polyline(g, points) {
  g.beginPath();
  for (let i = 0; i + 1 < points.length; i += 2) {
    if (i === 0) g.moveTo(points[0], points[1]);
    else g.lineTo(points[i], points[i + 1]);
  }
}
