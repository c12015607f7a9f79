// What a page can do once scripts run: turn a figure into one that zooms, and move the size of an effect.
// Without scripts every figure stands as it is, and the slider's figure shows the size that was found.
"use strict";
(() => {
  const NS = "http://www.w3.org/2000/svg";
  const KEYS = "+ and − zoom, arrow keys move, 0 shows all; drag over a span to enlarge it, double-click shows all";
  const LEFT = 62, RIGHT = 8, TOP = 6, BOTTOM = 34, GAP = 10;

  const put = (parent, name, attributes, words) => {
    const element = document.createElementNS(NS, name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    if (words !== undefined) element.textContent = words;
    parent.append(element);
    return element;
  };

  const numbers = (text) => {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    return Array.from(new Float32Array(bytes.buffer));
  };

  // Round numbers between two ends, about so many: 1, 2 or 5 times a power of ten apart.
  const ticks = (low, high, count) => {
    const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw));
    const step = power * [1, 2, 5, 10].find((k) => k * power >= raw);
    const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9)), found = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) found.push([k * step, (k * step).toFixed(digits)]);
    return found;
  };

  // The figure's curves over x in a box of the page; `show` draws the span it is given and says what lies under the cursor.
  class Chart {
    constructor(place, data) {
      this.columns = Object.fromEntries(Object.entries(data.columns).map(([name, text]) => [name, numbers(text)]));
      this.x = this.columns.x;
      this.curves = data.curves.map((c) => ({ ...c, values: c.minus
        ? this.columns[c.y].map((v, n) => v - this.columns[c.minus][n]) : this.columns[c.y] }));
      [this.title, this.upper, this.lower] = data.titles;
      this.place = place;
      this.width = Math.max(place.clientWidth, 320);
      this.height = Math.round(Math.min(420, 0.62 * this.width));
      this.svg = put(place, "svg", { viewBox: `0 0 ${this.width} ${this.height}`, role: "img" });
      this.told = place.appendChild(document.createElement("p"));
      this.told.className = "keys";
      this.all = [this.x[0], this.x[this.x.length - 1]];
      this.show(...this.all);
      this.listen();
    }

    at(x) { return LEFT + (x - this.from) / (this.to - this.from) * (this.width - LEFT - RIGHT); }
    under(event) {
      const box = this.svg.getBoundingClientRect();
      const share = ((event.clientX - box.left) / box.width * this.width - LEFT) / (this.width - LEFT - RIGHT);
      return this.from + Math.min(Math.max(share, 0), 1) * (this.to - this.from);
    }

    show(from, to) {
      if (!(to > from)) return;
      [this.from, this.to] = [from, to];
      Object.assign(this.place.dataset, { from, to });
      this.svg.replaceChildren();
      const two = this.curves.some((c) => c.lower), inner = this.height - TOP - BOTTOM;
      const first = two ? 0.66 * inner : inner;
      this.pane(this.curves.filter((c) => !c.lower), TOP, first, this.upper);
      if (two) this.pane(this.curves.filter((c) => c.lower), TOP + first + GAP, inner - first - GAP, this.lower);
      for (const [value, words] of ticks(from, to, 8))
        put(this.svg, "text", { x: this.at(value), y: this.height - 18, "text-anchor": "middle", "font-size": 11 }, words);
      put(this.svg, "text", { x: this.width / 2, y: this.height - 3, "text-anchor": "middle", "font-size": 12 }, this.title);
      this.cursor = put(this.svg, "line", { y1: TOP, y2: this.height - BOTTOM, style: "stroke: var(--mark)", visibility: "hidden" });
      this.band = put(this.svg, "rect", { y: TOP, height: inner, width: 0, style: "fill: var(--accent); fill-opacity: .2" });
      this.tell(null);
    }

    pane(curves, top, height, title) {
      let low = Infinity, high = -Infinity;
      const inside = this.x.map((x, n) => n).filter((n) => this.x[n] >= this.from && this.x[n] <= this.to);
      for (const { values } of curves) for (const n of inside) {
        if (values[n] < low) low = values[n];
        if (values[n] > high) high = values[n];
      }
      if (!(high >= low)) return;
      const air = 0.06 * (high - low) || 0.05 * Math.abs(high) || 1;
      [low, high] = [low - air, high + air];
      const y = (v) => top + (high - v) / (high - low) * height;
      for (const [value, words] of ticks(low, high, Math.max(2, height / 45))) {
        put(this.svg, "line", { x1: LEFT, x2: this.width - RIGHT, y1: y(value), y2: y(value), style: "stroke: var(--grid)" });
        put(this.svg, "text", { x: LEFT - 6, y: y(value) + 4, "text-anchor": "end", "font-size": 11 }, words);
      }
      put(this.svg, "text", { x: 12, y: top + height / 2, "text-anchor": "middle", "font-size": 12,
        transform: `rotate(-90 12 ${top + height / 2})` }, title);
      const first = Math.max((inside[0] ?? 0) - 1, 0), last = Math.min((inside.at(-1) ?? 0) + 2, this.x.length);
      const frame = put(this.svg, "svg", { x: LEFT, y: top, width: this.width - LEFT - RIGHT, height, overflow: "hidden" });
      for (const curve of curves) {
        let path = "", pen = "M";
        for (let n = first; n < last; n += 1) {
          if (!Number.isFinite(curve.values[n])) { pen = "M"; continue; }
          path += `${pen}${(this.at(this.x[n]) - LEFT).toFixed(1)} ${(y(curve.values[n]) - top).toFixed(1)}`;
          pen = "L";
        }
        put(frame, "path", { d: path, style: `fill: none; stroke: ${curve.color}; stroke-width: 1.4` });
      }
    }

    // The names of the curves, which are the legend, with their values at an instant where there is one.
    tell(x) {
      let n = 0;
      if (x !== null) while (n < this.x.length - 1 && this.x[n + 1] <= x) n += 1;
      this.told.replaceChildren(x === null ? "" : `${this.title} ${this.x[n].toPrecision(5)}: `);
      for (const curve of this.curves.filter((c) => !c.lower)) {
        const swatch = document.createElement("span");
        swatch.style.cssText = `display: inline-block; width: 1.4em; border-top: 3px solid ${curve.color}; margin: 0 .3em .25em 0`;
        this.told.append(swatch, curve.name + (x === null ? "" : ` ${curve.values[n].toPrecision(5)}`) + "  ");
      }
    }

    listen() {
      let start = null;
      this.svg.addEventListener("pointerdown", (e) => { start = this.under(e); this.svg.setPointerCapture(e.pointerId); });
      this.svg.addEventListener("pointermove", (e) => {
        const x = this.under(e), here = this.at(x);
        this.cursor.setAttribute("x1", here); this.cursor.setAttribute("x2", here);
        this.cursor.setAttribute("visibility", "visible");
        this.tell(x);
        if (start === null) return;
        this.band.setAttribute("x", Math.min(here, this.at(start)));
        this.band.setAttribute("width", Math.abs(here - this.at(start)));
      });
      this.svg.addEventListener("pointerup", (e) => {
        const end = this.under(e), begin = start;
        start = null;
        if (begin !== null && Math.abs(this.at(end) - this.at(begin)) > 5) this.show(Math.min(begin, end), Math.max(begin, end));
      });
      this.svg.addEventListener("pointerleave", () => { this.cursor.setAttribute("visibility", "hidden"); this.tell(null); });
      this.svg.addEventListener("dblclick", () => this.show(...this.all));
      this.place.addEventListener("keydown", (event) => {
        if (event.ctrlKey || event.altKey || event.metaKey) return;
        const middle = (this.from + this.to) / 2, half = (this.to - this.from) / 2;
        const spans = { "+": [middle - half / 2, middle + half / 2], "-": [middle - 2 * half, middle + 2 * half],
          ArrowLeft: [this.from - 0.4 * half, this.to - 0.4 * half], ArrowRight: [this.from + 0.4 * half, this.to + 0.4 * half],
          "0": this.all };
        const span = spans[event.key === "=" ? "+" : event.key];
        if (!span) return;
        event.preventDefault();
        this.show(...span);
      });
    }
  }

  const enlarge = (figure, button) => {
    const place = document.createElement("div");
    place.className = "chart";
    place.tabIndex = 0;
    place.setAttribute("role", "group");
    place.setAttribute("aria-label", figure.dataset.zoom + ". Keys: " + KEYS);
    figure.querySelector("svg").replaceWith(place);
    button.remove();
    new Chart(place, JSON.parse(figure.querySelector("script[type='application/json']").textContent));
    const keys = document.createElement("p");
    keys.className = "keys";
    keys.textContent = KEYS;
    place.after(keys);
    place.focus();
  };

  for (const figure of document.querySelectorAll("figure[data-zoom]")) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = "zoom";
    button.setAttribute("aria-label", "zoom: " + figure.dataset.zoom);
    button.addEventListener("click", () => enlarge(figure, button));
    figure.querySelector("figcaption").before(button);
  }

  for (const box of document.querySelectorAll("[data-sizes]")) {
    const data = JSON.parse(box.querySelector("script[type='application/json']").textContent);
    const slider = box.querySelector("input[type=range]");
    const shown = box.querySelector("output");
    const lines = [...box.querySelectorAll("svg .size")];
    const show = () => {
      const k = Number(slider.value);
      lines.forEach((line) => { line.style.display = Number(line.dataset.k) === k ? "" : "none"; });
      shown.textContent = data.labels[k];
    };
    slider.hidden = false;
    slider.addEventListener("input", show);
    show();
  }
})();
