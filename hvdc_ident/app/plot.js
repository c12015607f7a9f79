// Curves on canvas, drawn by uPlot: grids one above the other with one abscissa and one cursor, or a plane of points.
// put(grid, column, values) replaces one column of one grid's data; whole(grid, columns) replaces all of them.
const INK = "#7a8089", FAINT = "rgba(122,128,137,0.22)", FONT = "12px system-ui, sans-serif";
const axis = (label, side) => ({
  label, side, stroke: INK, font: FONT, labelFont: FONT, labelSize: 16, size: side === 2 ? 26 : 58, gap: 3,
  grid: { stroke: FAINT, width: 1 }, ticks: { stroke: FAINT, width: 1 },
});

// The ordinate's ends: a tenth beyond the curves, and of one that stands still a little about its level.
const spread = (u, low, high) => {
  if (low == null) return [0, 1];
  const pad = high > low ? 0.1 * (high - low) : 0.05 * Math.max(Math.abs(low), 0.02);
  return [low - pad, high + pad];
};

// A cross at each point of a series, as poles are drawn.
const crosses = (color) => (u, k) => {
  const ctx = u.ctx, r = 6 * devicePixelRatio;
  ctx.save();
  ctx.strokeStyle = color;
  ctx.lineWidth = 2.2 * devicePixelRatio;
  ctx.beginPath();
  u.data[0].forEach((x, n) => {
    const y = u.data[k][n];
    if (y == null) return;
    const a = u.valToPos(x, "x", true), b = u.valToPos(y, "y", true);
    ctx.moveTo(a - r, b - r); ctx.lineTo(a + r, b + r); ctx.moveTo(a - r, b + r); ctx.lineTo(a + r, b - r);
  });
  ctx.stroke();
  ctx.restore();
  return false;
};

export default {
  template: `<div class="plot" style="position:relative"></div>`,
  props: { grids: Array, xtitle: String, log: Boolean, plane: Boolean, height: Number, label: String },
  mounted() {
    this.plots = [];
    this.sync = uPlot.sync(this.log ? "frequency" : this.plane ? "plane" : "time");
    this.$el.setAttribute("role", "img");
    this.$el.setAttribute("aria-label", this.label || "");
    this.build();
    this.observer = new ResizeObserver(() => this.fit());
    this.observer.observe(this.$el);
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
          width: this.$el.clientWidth || 300, height: this.tall(g), series, padding: [8, 12, 0, 0],
          scales: { x: { time: false, distr: this.log ? 3 : 1 }, y: { range: spread } },
          axes: [{ ...axis(g === last ? this.xtitle : "", 2), size: g === last ? 34 : 8, values: g === last ? undefined : () => [] }, axis(grid.title, 3)],
          cursor: { sync: { key: this.sync.key }, drag: { x: true, y: this.plane } },
          legend: { show: true, live: !this.plane }, focus: { alpha: 1 },
        };
        const empty = [[], ...grid.curves.map(() => [])];
        const plot = new uPlot(options, this.data?.[g] ?? empty, this.$el);
        this.sync.sub(plot);
        return plot;
      });
      this.data = this.plots.map((p) => p.data);
    },
    curve(c) {
      const points = c.mark ? { show: c.mark === "cross" ? crosses(c.color) : true, size: c.size || 7, stroke: c.color, fill: c.mark === "ring" ? "transparent" : c.color } : { show: false };
      return {
        label: c.name, stroke: c.color, width: 1.5, dash: c.dashed ? [6, 4] : undefined, points, spanGaps: false,
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
  },
};
