// What a page can do once scripts run: enlarge a figure into one that zooms, and move the size of an effect.
// Without scripts every figure stands as it is, and the slider's figure shows the size that was found.
"use strict";
(() => {
  const library = document.getElementById("plotly");
  let loading = null;

  // The drawing library lies compressed in the page and is unpacked when it is first asked for.
  const loaded = () => loading ??= (async () => {
    const packed = Uint8Array.from(atob(library.textContent.trim()), (c) => c.charCodeAt(0));
    const text = await new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
    const script = document.createElement("script");
    script.src = URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
    await new Promise((done, failed) => { script.onload = done; script.onerror = failed; document.head.append(script); });
  })();

  const numbers = (text) => {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    return Array.from(new Float32Array(bytes.buffer));
  };

  const traces = (data) => {
    const columns = Object.fromEntries(Object.entries(data.columns).map(([name, text]) => [name, numbers(text)]));
    return data.curves.map((curve) => ({
      type: "scatter", mode: "lines", name: curve.name, line: { color: curve.color, width: 1.3 }, x: columns.x,
      y: curve.minus ? columns[curve.y].map((v, n) => v - columns[curve.minus][n]) : columns[curve.y],
      yaxis: curve.lower ? "y2" : "y",
    }));
  };

  // What a mouse does by dragging: every key gives the range of the time axis that is shown next.
  const KEYS = "+ and − zoom, arrow keys move, 0 shows all";
  const zoom = (factor) => (a, b) => [(a + b) / 2 - factor * (b - a) / 2, (a + b) / 2 + factor * (b - a) / 2];
  const shift = (share) => (a, b) => [a + share * (b - a), b + share * (b - a)];
  const MOVES = {
    "+": zoom(0.5), "=": zoom(0.5), "-": zoom(2), "ArrowLeft": shift(-0.2), "ArrowRight": shift(0.2),
    "0": (a, b, all) => [...all],
  };

  const enlarge = async (figure, button) => {
    const data = JSON.parse(figure.querySelector("script[type='application/json']").textContent);
    const [x, upper, lower] = data.titles;
    button.disabled = true;
    button.textContent = "…";
    await loaded();
    const place = document.createElement("div");
    place.style.height = "26rem";
    figure.querySelector("svg").replaceWith(place);
    button.remove();
    await Plotly.newPlot(place, traces(data), {
      xaxis: { title: { text: x }, anchor: "y2" }, yaxis: { title: { text: upper }, zeroline: false, domain: [0.3, 1] },
      yaxis2: { title: { text: lower }, domain: [0, 0.24] }, margin: { t: 30, r: 10, b: 45, l: 65 },
      legend: { orientation: "h", y: 1.12 }, hovermode: "x unified",
    }, { responsive: true, displaylogo: false });
    place.tabIndex = 0;
    place.setAttribute("role", "group");
    place.setAttribute("aria-label", figure.dataset.zoom + ". Keys: " + KEYS);
    const keys = document.createElement("p");
    keys.className = "keys";
    keys.textContent = KEYS;
    figure.append(keys);
    const all = [...place.layout.xaxis.range];
    place.addEventListener("keydown", (event) => {
      const move = MOVES[event.key];
      if (!move || event.ctrlKey || event.altKey || event.metaKey) return;
      event.preventDefault();
      Plotly.relayout(place, { "xaxis.range": move(...place.layout.xaxis.range, all) });
    });
    place.focus();
  };

  if (library && "DecompressionStream" in window) {
    for (const figure of document.querySelectorAll("figure[data-zoom]")) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = "zoom";
      button.setAttribute("aria-label", "zoom: " + figure.dataset.zoom);
      button.addEventListener("click", () => enlarge(figure, button));
      figure.prepend(button);
    }
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
