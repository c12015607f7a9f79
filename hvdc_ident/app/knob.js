// One parameter: a slider between two ends, the value and the ends to be typed, and whether it is to be fitted. The elements are the
// browser's own, and nothing of them is drawn anew while the slider moves. put(value) sets the slider.
const STEPS = 500;
const shown = (v) => String(+v.toPrecision(5));

export default {
  template: `<div class="knob">
    <label><input type="checkbox" ref="fit"><span ref="name"></span></label>
    <span class="amount"><input class="value" inputmode="decimal" ref="value"><span class="unit" ref="unit"></span></span>
    <input class="end" inputmode="decimal" ref="low"><input type="range" min="0" max="${STEPS}" ref="slider"><input class="end" inputmode="decimal" ref="high">
  </div>`,
  props: { name: String, title: String, unit: String, low: Number, high: Number, value: Number, fit: { type: Boolean, default: null } },
  emits: ["moved", "began", "spanned", "chosen"],
  mounted() {
    const { fit, name, unit, value, low, high, slider } = this.$refs;
    name.textContent = this.name;
    name.title = this.title;
    unit.textContent = this.unit;
    const named = { value: "value", low: "lower bound", high: "upper bound" };
    for (const [key, words] of Object.entries(named)) this.$refs[key].setAttribute("aria-label", `${this.name}, ${words}`);
    slider.setAttribute("aria-label", this.name);
    fit.setAttribute("aria-label", `fit ${this.name}`);
    fit.hidden = this.fit === null;
    fit.checked = !!this.fit;
    this.span = [this.low, this.high];
    this.put(this.value);
    slider.oninput = () => {
      this.at = this.valueAt(+slider.value);
      this.show();
      this.$emit("moved", this.at);
    };
    slider.onpointerdown = slider.onfocus = () => this.$emit("began");
    fit.onchange = () => this.$emit("chosen", fit.checked);
    value.onchange = () => {
      const typed = this.typed(value);
      if (typed === null) return;
      this.$emit("began");
      if (typed < this.span[0] || typed > this.span[1]) this.stretch([Math.min(typed, this.span[0]), Math.max(typed, this.span[1])]);
      this.put(typed);
      this.$emit("moved", typed);
    };
    low.onchange = high.onchange = () => {
      const ends = [this.typed(low), this.typed(high)];
      const wrong = ends.includes(null) || ends[0] >= ends[1];
      for (const field of [low, high]) field.classList.toggle("wrong", wrong);
      if (!wrong) this.stretch(ends);
    };
    for (const field of [value, low, high]) field.onkeydown = (e) => { if (e.key === "Enter") field.blur(); };
  },
  methods: {
    // The number in a field; null, and the field marked, where there is none.
    typed(field) {
      const number = field.value.trim() === "" ? NaN : Number(field.value.replace(",", "."));
      field.classList.toggle("wrong", !Number.isFinite(number));
      return Number.isFinite(number) ? number : null;
    },
    log() { return this.span[0] > 0 && this.span[1] > 20 * this.span[0]; },
    valueAt(step) {
      const [a, b] = this.log() ? this.span.map(Math.log) : this.span, v = a + ((b - a) * step) / STEPS;
      return this.log() ? Math.exp(v) : v;
    },
    stretch(span) {
      this.span = span;
      this.put(this.at);
      this.$emit("spanned", span);
    },
    put(value) {
      this.at = value;
      const of = this.log() ? (v) => Math.log(Math.max(v, 1e-300)) : (v) => v, [a, b] = this.span.map(of);
      this.$refs.slider.value = Math.round((STEPS * (of(value) - a)) / (b - a));
      this.$refs.low.value = shown(this.span[0]);
      this.$refs.high.value = shown(this.span[1]);
      this.show();
    },
    show() {
      this.$refs.value.value = shown(this.at);
      this.$refs.value.classList.remove("wrong");
      this.$refs.slider.setAttribute("aria-valuetext", `${shown(this.at)} ${this.unit}`);
    },
  },
};
