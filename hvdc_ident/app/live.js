// HTML that is replaced without a change of an element, which would draw the whole page anew.
export default {
  template: "<div></div>",
  emits: ["ready"],
  mounted() { this.$emit("ready"); },  // what was sent before it stood on the page is lost
  methods: { put(html) { this.$el.innerHTML = html; } },
};
