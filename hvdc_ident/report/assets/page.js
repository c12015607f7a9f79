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

  const enlarge = async (figure, button) => {
    const data = JSON.parse(figure.querySelector("script[type='application/json']").textContent);
    button.disabled = true;
    button.textContent = "…";
    await loaded();
    const place = document.createElement("div");
    place.style.height = "26rem";
    figure.querySelector("svg").replaceWith(place);
    button.remove();
    await Plotly.newPlot(place, data.traces, { ...data.layout, margin: { t: 30, r: 10, b: 45, l: 65 }, showlegend: true,
      legend: { orientation: "h", y: 1.12 }, hovermode: "x unified" }, { responsive: true, displaylogo: false });
    place.tabIndex = 0;
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
      lines.forEach((line, n) => { line.style.display = n === k ? "" : "none"; });
      shown.textContent = data.labels[k];
    };
    slider.hidden = false;
    slider.addEventListener("input", show);
    show();
  }
})();
