"use strict";
// Live view: every frame is the whole page, so that a page that connects again needs nothing of before.
(() => {
  const get = (id) => document.getElementById(id), status = document.documentElement.dataset;
  const group = new Group(), charts = new Map();
  let plan = null, socket = null, last = 0;
  const cells = (row) => row.map(([text, level]) => element("td", level ? { class: level } : {}, text));

  function show(frame) {
    last = performance.now();
    document.body.classList.toggle("gone", frame.old);
    trust(frame.trust.level, frame.trust.word, frame.trust.why);
    status.frames = Number(status.frames || 0) + 1;
    if (frame.log === undefined) { get("when").textContent = ""; return; }
    status.t = frame.t;
    status.behind = frame.behind ?? "";
    get("log").textContent = frame.log;
    get("when").textContent = `${clock(frame.t)} min:s${frame.ended ? ", end of the log" : frame.behind === null ? ", playback" : `, ${frame.behind.toFixed(1)} s behind`}`;
    get("numbers").replaceChildren(...frame.numbers.map(([name, value]) => element("div", {}, element("dt", {}, name), element("dd", {}, value))));
    get("sources").replaceChildren(...frame.sources.map((s) => {
      const bar = element("span", { class: "bar" }, element("span", { style: `width:${s.false ?? 0}%` }));
      const probability = element("td", {}, ...(s.false === null ? ["–"] : [bar, s.false.toFixed(1)]));
      return element("tr", {}, ...cells([[s.name], [s.state, s.level]]), probability, ...cells([[s.age === null ? "–" : s.age.toFixed(1)]]));
    }));
    get("events").replaceChildren(...frame.events.map(([t, severity, text]) =>
      element("tr", {}, ...cells([[clock(t)], [text, severity <= 3 ? "fault" : severity === 4 ? "caution" : ""]]))));
    if (plan === null) {
      plan = new Plan(get("map"), frame.map, group, window.innerWidth < 700 ? "360px" : "560px");
    } else plan.update(frame.map);
    for (const figure of frame.charts) {
      if (!figure.lines.some((line) => line.x.length)) continue;
      const chart = charts.get(figure.key);
      if (chart) { chart.update(figure); continue; }
      const box = element("div", { class: "plot" });
      get("charts").append(element("section", {}, element("h2", {}, figure.title), box));
      charts.set(figure.key, new Chart(box, figure, group, 190));
    }
    if (!group.range) group.zoom(null);
    paintLegends();
  }

  function trust(level, word, why) {
    const box = get("trust");
    box.className = `verdict ${level}`;
    box.children[0].textContent = `${{ good: "●", caution: "▲", fault: "■" }[level]} ${word}`;
    box.children[1].textContent = why;
    document.title = `${word} · companion live`;
  }

  function connect() {
    socket = new WebSocket(`ws://${location.host}/socket`);
    socket.onmessage = (event) => show(JSON.parse(event.data));
    socket.onclose = () => setTimeout(connect, 500);
  }

  setInterval(() => {
    if (performance.now() - last < 3000) return;
    document.body.classList.add("gone");
    trust("fault", "Not connected", "The live view has stopped or cannot be reached; the flight does not depend on it. Trying again.");
  }, 500);
  darkness.addEventListener("change", () => repaintAll([group]));
  connect();
})();
