"use strict";
// Draws every figure of the page once; then `data-drawn` on <html> is the number drawn, `data-failed` of failures.
(() => {
  const figures = JSON.parse(document.getElementById("figures").textContent);
  const narrow = window.innerWidth < 700;
  const config = { responsive: true, displayModeBar: false };
  const status = document.documentElement.dataset;
  const draw = ([key, figure]) => {
    if (narrow) {
      figure.layout.font.size = 10.5;
      figure.layout.margin.l = 46;
      figure.layout.dragmode = false;  // a finger scrolls the page
      const names = figure.layout.showlegend ? figure.data.filter((trace) => trace.name).length : 0;
      const plot = document.getElementById("plot-" + key);
      if (plot) plot.style.height = plot.clientHeight + 17 * Math.max(0, names - 4) + "px";  // a name a line
    }
    return Plotly.newPlot("plot-" + key, figure.data, figure.layout, config);
  };
  Promise.allSettled(Object.entries(figures).map((entry) => Promise.resolve(entry).then(draw))).then((ends) => {
    for (const end of ends) if (end.status === "rejected") console.error(end.reason);
    status.failed = ends.filter((end) => end.status === "rejected").length;
    status.drawn = document.querySelectorAll(".plot .main-svg").length ? ends.length - status.failed : 0;
    status.overflow = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  });
})();
