// Curves on canvas, drawn by uPlot: grids one above the other with one abscissa and one cursor, or a plane of points.
// put(grid, column, values) replaces one column of one grid's data; whole(grid, columns) replaces all of them, and
// refine(grid, columns) does so while the same part of the abscissa stays in view. mark(key, at) moves a marker. shade(grid, bands) shades
// spans of the abscissa, each {first, last, kind, what}.
// Of a plane it draws what lies on it: the axis of the imaginary numbers, and at each pole its frequency and damping.
const FONT = "12px system-ui, sans-serif", WIDE = 62;
const ink = () => paint("var(--soft)"), faint = () => paint("var(--grid)");
const axis = (label, side) => ({
  label, side, stroke: ink, font: FONT, labelFont: FONT, labelSize: 16, size: side === 2 ? 26 : WIDE, gap: 3, space: side === 2 ? 60 : 18,
  grid: { stroke: faint, width: 1 }, ticks: { stroke: faint, width: 1 },
});

// Numbers along an axis with as many decimals as tell them apart.
const digits = (u, splits, axis, space, step) => {
  const far = Math.max(...splits.map((v) => Math.abs(v ?? 0)));
  if (far >= 1e5 || (far > 0 && far < 1e-2)) return splits.map((v) => (v == null ? "" : v ? (+v.toPrecision(3)).toExponential() : "0"));
  let places = 0;
  while (places < 12 && Math.abs(step * 10 ** places - Math.round(step * 10 ** places)) > 1e-6) places += 1;
  return splits.map((v) => (v == null ? "" : v.toFixed(places)));
};

// Along a logarithmic axis the decades alone: 1, 10, 100, 1k, 10k.
const decades = (u, splits) => splits.map((v) => {
  if (v == null || Math.abs(Math.log10(v) - Math.round(Math.log10(v))) > 1e-9) return "";
  return v >= 1e6 ? `${v / 1e6}M` : v >= 1e3 ? `${v / 1e3}k` : String(+v.toPrecision(1));
});

// A plane's ends: around 0 and beyond all points, so that none stands on an edge; of a part that is looked at, its own.
const around = (u, low, high, key) => {
  const all = (key === "x" ? u.data[0] : u.data.slice(1).flatMap((c) => [...c])).filter((v) => v != null);
  if (low > Math.min(...all) || high < Math.max(...all)) return [low, high];
  const [a, b] = [Math.min(low ?? 0, 0), Math.max(high ?? 0, 0)], pad = 0.12 * (b - a || 1);
  return [a - pad, b + pad];
};

// The ordinate's ends: a tenth beyond the curves, and of one that stands still a little about its level.
const spread = (u, low, high) => {
  if (low == null) return [0, 1];
  const pad = high > low ? 0.1 * (high - low) : 0.05 * Math.max(Math.abs(low), 0.02);
  return [low - pad, high + pad];
};

// A colour of the style sheet as a canvas takes it, on the ground that the page has now.
const paint = (color) => (color.startsWith("var(") ? getComputedStyle(document.body).getPropertyValue(color.slice(4, -1)).trim() : color);

// A cross at each point of a series, as poles are drawn.
const crosses = (color) => (u, k) => {
  const ctx = u.ctx, r = 6 * devicePixelRatio;
  ctx.save();
  ctx.strokeStyle = paint(color);
  ctx.lineWidth = 2.2 * devicePixelRatio;
  ctx.beginPath();
  u.data[0].forEach((x, n) => {
    const y = u.data[k][n];
    if (y == null) return;
    const a = u.valToPos(x, "x", true), b = u.valToPos(y, "y", true);
    ctx.moveTo(a - r, b - r); ctx.lineTo(a + r, b + r); ctx.moveTo(a - r, b + r); ctx.lineTo(a + r, b - r);
  });
  ctx.stroke();
  label(u, k, ctx);
  ctx.restore();
  return false;
};

// What a pole is, beside its cross: of a pair its frequency and damping, else its time constant; where there is room for it.
const named = (x, y) => {
  const size = Math.hypot(x, y), text = (v) => String(+v.toPrecision(3));
  if (y) return `${text(Math.abs(y) / (2 * Math.PI))} Hz, ζ ${text(-x / size)}`;
  if (!x) return "0";
  const time = 1 / Math.abs(x), [scale, unit] = time < 1e-3 ? [1e6, "µs"] : time < 1 ? [1e3, "ms"] : [1, "s"];
  return `${text(time * scale)} ${unit}${x > 0 ? ", unstable" : ""}`;
};
const label = (u, k, ctx) => {
  const px = devicePixelRatio, tall = 14 * px, apart = 9 * px;
  const places = [...u.data[0]].flatMap((x, n) => (u.data[k][n] == null ? [] : [[u.valToPos(x, "x", true), u.valToPos(u.data[k][n], "y", true)]]));
  const taken = places.map(([a, b]) => [a - 6 * px, b - 6 * px, a + 6 * px, b + 6 * px]);  // no words on a cross
  const free = (box) => box[0] >= u.bbox.left && box[2] <= u.bbox.left + u.bbox.width && !taken.some((o) => box[0] < o[2] && box[2] > o[0] && box[1] < o[3] && box[3] > o[1]);
  ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
  ctx.fillStyle = paint("var(--ink)");
  ctx.textAlign = "left";
  ctx.textBaseline = "alphabetic";
  u.data[0].forEach((x, n) => {
    const y = u.data[k][n];
    if (y == null || y < 0) return;  // the other of a pair says the same
    const words = named(x, y), wide = ctx.measureText(words).width, a = u.valToPos(x, "x", true), b = u.valToPos(y, "y", true);
    const sides = [[a + apart, b], [a - apart - wide, b], [a - wide / 2, b - apart], [a - wide / 2, b + apart + tall]];
    const box = sides.map(([left, foot]) => [left, foot - tall, left + wide, foot]).find(free);
    if (!box) return;
    taken.push(box);
    ctx.fillText(words, box[0], box[3] - 3 * px);
  });
};

// The line between the stable and the unstable half of a plane.
const upright = (u) => {
  const x = u.valToPos(0, "x", true), { ctx, bbox } = u;
  if (x < bbox.left || x > bbox.left + bbox.width) return;
  ctx.save();
  ctx.strokeStyle = ink();
  ctx.lineWidth = devicePixelRatio;
  ctx.beginPath();
  ctx.moveTo(x, bbox.top); ctx.lineTo(x, bbox.top + bbox.height);
  ctx.stroke();
  ctx.restore();
};

export default {
  template: `<div class="plot" style="position:relative"></div>`,
  props: { grids: Array, xtitle: String, log: Boolean, plane: Boolean, height: Number, label: String, markers: Array },
  emits: ["ready", "marked", "viewed"],
  mounted() {
    this.plots = [];
    this.bands = {};
    this.at = Object.fromEntries((this.markers || []).map((m) => [m.key, m.at]));
    this.sync = uPlot.sync(this.log ? "frequency" : this.plane ? "plane" : "time");
    this.$el.setAttribute("role", "img");
    this.$el.setAttribute("aria-label", this.label || "");
    this.build();
    this.observer = new ResizeObserver(() => this.fit());
    this.observer.observe(this.$el);
    this.$emit("ready");  // what was sent to a plot before it stood on the page is lost
  },
  beforeUnmount() {
    this.observer.disconnect();
    this.plots.forEach((p) => p.destroy());
  },
  methods: {
    build() {
      this.plots.forEach((p) => p.destroy());
      this.$el.replaceChildren();
      const last = this.grids.length - 1;
      this.plots = this.grids.map((grid, g) => {
        const series = [{ label: this.xtitle, value: (u, v) => (v == null ? "–" : v.toPrecision(5)) }];
        grid.curves.forEach((c) => series.push(this.curve(c)));
        const options = {
          width: this.$el.clientWidth || 300, height: this.tall(g), series, padding: [8, 20, 0, 0],
          scales: { x: { time: false, distr: this.log ? 3 : 1, ...this.ends() }, y: { range: this.plane ? around : spread } },
          axes: [{ ...axis(g === last ? this.xtitle : "", 2), size: g === last ? 34 : 8, values: g < last ? () => [] : this.log ? decades : digits }, { ...axis(grid.title, 3), values: digits }],
          cursor: { sync: { key: this.sync.key }, drag: { x: true, y: this.plane } },
          legend: { show: true, live: !this.plane, markers: { dash: (u, k) => (k && !this.plane && grid.curves[k - 1].mark ? "dotted" : u.series[k].dash ? "dashed" : "solid") } }, focus: { alpha: 1 },
          hooks: this.plane ? { drawAxes: [upright] } : { ...(this.markers?.length ? this.marking(g) : {}), ...this.shading(g) },
        };
        const empty = [[], ...grid.curves.map(() => [])];
        const plot = new uPlot(options, this.data?.[g] ?? empty, this.$el);
        this.sync.sub(plot);
        return plot;
      });
      this.data = this.plots.map((p) => p.data);
    },
    // The markers of one grid: lines over it that follow its scale, are dragged, and answer the arrow keys.
    marking(g) {
      return {
        init: [(u) => {
          u.lines = this.markers.map((m) => {
            const line = document.createElement("div");
            line.className = "marker";
            line.style.color = m.color;
            line.innerHTML = "<i></i><b></b>";
            line.lastChild.style.top = `${12 * this.markers.indexOf(m)}px`;  // where two stand at one place
            if (g === 0) {
              line.lastChild.textContent = m.label;
              line.tabIndex = 0;
              line.setAttribute("role", "slider");
              line.setAttribute("aria-label", `${m.label}, s`);
            }
            const put = (value) => {
              const x = this.span();
              this.mark(m.key, Math.min(Math.max(value, x[0]), x[1]));
            };
            line.onmousedown = (e) => e.stopPropagation();  // else the plot begins to select
            line.onpointerdown = (e) => { line.setPointerCapture(e.pointerId); e.preventDefault(); line.focus(); };
            line.onpointermove = (e) => {
              if (line.hasPointerCapture(e.pointerId)) put(u.posToVal(e.clientX - u.over.getBoundingClientRect().left, "x"));
            };
            line.onpointerup = () => this.$emit("marked", { key: m.key, at: this.at[m.key] });
            line.onkeydown = (e) => {
              const step = { ArrowLeft: -1, ArrowRight: 1 }[e.key];
              if (!step) return;
              e.preventDefault();
              put(this.at[m.key] + step * (u.posToVal(1, "x") - u.posToVal(0, "x")) * (e.shiftKey ? 10 : 1));
              this.$emit("marked", { key: m.key, at: this.at[m.key] });
            };
            u.over.appendChild(line);
            return line;
          });
        }],
        draw: [(u) => this.place(u)],
        setScale: [(u, key) => {
          if (g !== 0 || key !== "x" || this.refining || u.scales.x.min == null) return;
          clearTimeout(this.later);
          this.later = setTimeout(() => this.$emit("viewed", { from: u.scales.x.min, to: u.scales.x.max }), 120);
        }],
      };
    },
    // The bands of one grid: below its curves, each with its kind at the foot where there is room, and what it is as the pointer's title.
    shading(g) {
      const ends = (u, band, canvas) => {  // one row is seen too
        const [a, b] = [band.first, band.last].map((t) => u.valToPos(t, "x", canvas)), thin = 1.5 * (canvas ? devicePixelRatio : 1);
        return [a - thin, b + thin];
      };
      return {
        drawAxes: [(u) => {
          const { ctx, bbox } = u, px = devicePixelRatio;
          ctx.save();
          ctx.beginPath();
          ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
          ctx.clip();
          ctx.font = `${11 * px}px system-ui, sans-serif`;
          ctx.textAlign = "left";
          ctx.textBaseline = "alphabetic";
          let taken = bbox.left;
          for (const band of this.bands[g] || []) {
            const [a, b] = ends(u, band, true), wide = ctx.measureText(band.kind).width;
            ctx.globalAlpha = 0.25;
            ctx.fillStyle = paint("var(--given)");
            ctx.fillRect(a, bbox.top, b - a, bbox.height);
            const left = Math.min(Math.max(a, bbox.left) + 3 * px, bbox.left + bbox.width - wide);
            if (left < taken || b < bbox.left || a > bbox.left + bbox.width) continue;
            ctx.globalAlpha = 1;
            ctx.fillStyle = paint("var(--ink)");
            ctx.fillText(band.kind, left, bbox.top + bbox.height - 4 * px);
            taken = left + wide + 3 * px;
          }
          ctx.restore();
        }],
        setCursor: [(u) => {
          const at = u.cursor.left, met = (this.bands[g] || []).filter((band) => {
            const [a, b] = ends(u, band, false);
            return at >= a - 2 && at <= b + 2;
          });
          const said = met.map((band) => `${band.kind}: ${band.what}`).join("\n");
          if (u.over.title !== said) u.over.title = said;
        }],
      };
    },
    // The ends of the abscissa: of a plane around 0, of decades the data's own; else the plot's.
    ends() {
      return this.plane ? { range: around } : this.log ? { range: (u, low, high) => [low ?? 1, high ?? 10] } : {};
    },
    span() {
      const x = this.plots[0].data[0];
      return [x[0], x[x.length - 1]];
    },
    place(u) {
      const width = u.over.clientWidth;
      this.markers.forEach((m, k) => {
        const x = u.valToPos(this.at[m.key], "x");
        u.lines[k].style.display = x >= -1 && x <= width + 1 ? "" : "none";
        u.lines[k].style.left = `${x}px`;
        u.lines[k].setAttribute("aria-valuenow", this.at[m.key]);
        const name = u.lines[k].lastChild;  // on the side where there is room
        name.style.left = x > width - 60 ? "auto" : "9px";
        name.style.right = x > width - 60 ? "9px" : "auto";
      });
    },
    curve(c) {
      const points = c.mark ? { show: c.mark === "cross" ? crosses(c.color) : true, size: c.size || 7, stroke: () => paint(c.color), fill: () => (c.mark === "ring" ? "transparent" : paint(c.color)) } : { show: false };
      return {
        label: c.name, stroke: () => paint(c.color), width: 1.5, dash: c.dashed ? [6, 4] : undefined, points, spanGaps: false,
        paths: c.mark ? () => null : undefined, value: (u, v) => (v == null ? "–" : v.toPrecision(5)),
      };
    },
    tall(g) {
      const foot = 26, legend = 18;  // px: of the last grid's abscissa, of every grid's legend
      return Math.max(60, (this.height - foot) / this.grids.length - legend + (g === this.grids.length - 1 ? foot : 0));
    },
    fit() {
      const width = this.$el.clientWidth;
      if (width) this.plots.forEach((p, g) => p.setSize({ width, height: this.tall(g) }));
    },
    put(grid, column, values) {
      const data = [...this.plots[grid].data];
      data[column] = values;
      this.plots[grid].setData(data);
    },
    whole(grid, columns) {
      this.plots[grid].setData(columns);
    },
    refine(grid, columns) {
      const plot = this.plots[grid], { min, max } = plot.scales.x;
      this.refining = true;
      plot.setData(columns, min == null);
      if (min != null) plot.setScale("x", { min, max });
      setTimeout(() => { this.refining = false; }, 0);  // the plot says so in a microtask
    },
    shade(grid, bands) {
      this.bands[grid] = bands;
      this.plots[grid].redraw(false);
    },
    mark(key, at) {
      this.at[key] = at;
      this.plots.forEach((u) => this.place(u));
    },
  },
};
