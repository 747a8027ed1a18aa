"use strict";
// Draws every figure of the page once; then `data-drawn` on <html> is the number drawn, `data-failed` of failures.
(() => {
  const figures = JSON.parse(document.getElementById("figures").textContent);
  const groups = new Map(), status = document.documentElement.dataset;
  let drawn = 0, failed = 0;
  for (const [id, figure] of Object.entries(figures)) {
    const block = id.slice(0, -figure.key.length);
    if (!groups.has(block)) groups.set(block, new Group());
    try {
      new (figure.origin ? Plan : Chart)(document.getElementById(`plot-${id}`), figure, groups.get(block));
      drawn += 1;
    } catch (error) {
      console.error(error);
      failed += 1;
    }
  }
  for (const group of groups.values()) group.zoom(null);  // the same time axis everywhere
  paintLegends();
  const repaint = () => repaintAll(groups.values());
  darkness.addEventListener("change", repaint);
  // paper is light, and narrower than a screen
  addEventListener("beforeprint", () => {
    status.theme = "light";
    document.body.style.width = "700px";
    for (const group of groups.values()) for (const chart of group.charts) chart.resize();
    repaint();
  });
  addEventListener("afterprint", () => {
    delete status.theme;
    document.body.style.width = "";
    repaint();
  });
  for (const button of document.querySelectorAll("button[data-zoom]")) {
    button.addEventListener("click", () => { for (const group of groups.values()) group.zoom(null); });
  }
  Object.assign(status, { drawn, failed, overflow: document.documentElement.scrollWidth - document.documentElement.clientWidth });
})();
