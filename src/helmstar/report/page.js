(function () {
  "use strict";
  // Traces are written in the light palette; this maps each colour to its dark counterpart (style.py lists both).
  const DARK = {"#0067a8": "#5cb3f0", "#c4500a": "#ff9a4d", "#00805c": "#2fc79a", "#b0548f": "#e693cb",
    "#8f6a00": "#e3bf2b", "#2a7fa3": "#8fd3f4", "#5c6470": "#aab2bd", "#5b3fa8": "#ab97f7", "#b3203a": "#ff7a8c",
    "#1b2027": "#e4e8ee"};
  const dash = {solid: "", dash: "7 4", dot: "2 3", dashdot: "7 3 2 3", longdash: "11 4", longdashdot: "11 3 2 3"};
  const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16)).join(",");
  const DARK_RGB = {};
  for (const key of Object.keys(DARK)) DARK_RGB[rgb(key)] = rgb(DARK[key]);
  const darkMedia = window.matchMedia("(prefers-color-scheme: dark)");
  const touch = window.matchMedia("(pointer: coarse)").matches;
  let printing = false;
  const isDark = () => darkMedia.matches && !printing;

  function colour(value) {
    if (!isDark() || typeof value !== "string") return value;
    if (value[0] === "#") return DARK[value] || value;
    const parts = /^rgba\((\d+,\d+,\d+),([\d.]+)\)$/.exec(value.replace(/ /g, ""));
    if (!parts || !DARK_RGB[parts[1]]) return value;
    return "rgba(" + DARK_RGB[parts[1]] + "," + parts[2] + ")";
  }

  const element = document.getElementById("page-data");
  const page = element ? JSON.parse(element.textContent) : {arrays: [], figures: []};
  const decoded = [];
  function array(index) {
    if (!decoded[index]) {
      const entry = page.arrays[index];
      const bytes = Uint8Array.from(atob(entry.b), (c) => c.charCodeAt(0));
      decoded[index] = entry.t === "f4" ? new Float32Array(bytes.buffer) : new Float64Array(bytes.buffer);
    }
    return decoded[index];
  }
  // A fresh copy for plotly, with arrays filled in and colours of the theme.
  function build(value) {
    if (Array.isArray(value)) return value.map(build);
    if (value === null || typeof value !== "object") return colour(value);
    if ("$array" in value) return array(value.$array);
    const copy = {};
    for (const key of Object.keys(value)) copy[key] = build(value[key]);
    return copy;
  }

  function theme(layout, narrow) {
    const style = getComputedStyle(document.documentElement);
    const get = (name) => (printing ? {"--fg": "#000000", "--line": "#bbbbbb", "--panel": "#ffffff"}[name]
      : style.getPropertyValue(name).trim());
    layout.font = Object.assign({}, layout.font, {color: get("--fg"), family: getComputedStyle(document.body).fontFamily,
      size: narrow ? 11 : 12});
    layout.paper_bgcolor = layout.plot_bgcolor = "rgba(0,0,0,0)";
    layout.showlegend = false;
    layout.hoverlabel = {bgcolor: get("--panel"), bordercolor: get("--line"), font: {color: get("--fg")}};
    layout.modebar = {bgcolor: "rgba(0,0,0,0)", color: get("--soft") || "#444", activecolor: get("--fg")};
    if (touch) layout.dragmode = false; // a finger on a plot scrolls the page
    for (const key of Object.keys(layout)) {
      if (!/^[xy]axis\d*$/.test(key)) continue;
      Object.assign(layout[key], {gridcolor: get("--line"), zerolinecolor: get("--line"), linecolor: get("--line")});
    }
    return layout;
  }

  const NS = "http://www.w3.org/2000/svg";
  function svg(name, attributes, parent) {
    const node = document.createElementNS(NS, name);
    for (const key of Object.keys(attributes)) node.setAttribute(key, attributes[key]);
    if (parent) parent.appendChild(node);
    return node;
  }
  const SHAPES = {circle: "M18 3a4 4 0 1 0 .01 0z", square: "M14.5 3.5h7v7h-7z", diamond: "M18 2l5 5l-5 5l-5-5z",
    cross: "M16.7 2.5h2.6v3.2h3.2v2.6h-3.2v3.2h-2.6v-3.2h-3.2v-2.6h3.2z", x: "M14.5 3.5l7 7M21.5 3.5l-7 7",
    "triangle-up": "M18 2.5l4.5 8h-9z", "triangle-down": "M18 11.5l4.5-8h-9z", pentagon: "M18 2.5l4.5 3.4l-1.7 5.3h-5.6l-1.7-5.3z"};
  function swatch(trace) {
    const mark = svg("svg", {width: 36, height: 14, "aria-hidden": "true"});
    const line = trace.line || {};
    const marker = trace.marker || {};
    if (trace.type === "bar" || trace.fill) {
      svg("rect", {x: 4, y: 2, width: 28, height: 10, fill: trace.fillcolor || marker.color || "none"}, mark);
    }
    if (!trace.fill && trace.type !== "bar" && (trace.mode || "lines").includes("lines")) {
      svg("line", {x1: 2, x2: 34, y1: 7, y2: 7, stroke: line.color, "stroke-width": Math.max(1.5, line.width || 2),
        "stroke-dasharray": dash[line.dash || "solid"] || ""}, mark);
    }
    if ((trace.mode || "").includes("markers")) {
      const open = /-open/.test(marker.symbol || "");
      const shape = String(marker.symbol || "circle").replace("-open", "");
      svg("path", {d: SHAPES[shape] || SHAPES.circle, fill: open || shape === "x" ? "none" : marker.color, stroke: marker.color,
        "stroke-width": shape === "x" ? 2 : 1.2}, mark);
    }
    return mark;
  }

  class Figure {
    constructor(node) {
      this.node = node;
      this.spec = page.figures[Number(node.dataset.figure)];
      this.plot = node.querySelector(".plot");
      this.select = node.querySelector("select");
      this.legend = node.querySelector(".legend");
      this.note = node.querySelector(".note");
      this.viewName = null;
      this.shown = {};
      this.drawn = false;
      if (this.select) this.select.addEventListener("change", () => choose(this, this.select.value));
    }
    variant() {
      const name = this.select ? this.select.value : "";
      return this.spec.variants.find((one) => one.name === name) || this.spec.variants[0];
    }
    narrow() { return this.plot.clientWidth < 520; }
    draw() {
      if (!this.plot.clientWidth) return false;
      const variant = this.variant();
      this.wasNarrow = this.narrow();
      const data = build(variant.data);
      const layout = theme(build(variant.layout), this.wasNarrow);
      const meta = layout.meta || {};
      const views = meta.views || {};
      const names = Object.keys(views);
      if (!(this.viewName in views)) this.viewName = names[0];
      if (names.length) apply(layout, views[this.viewName]);
      layout.uirevision = variant.name + "|" + this.viewName; // a zoom survives a click in the legend
      if (this.wasNarrow) {
        for (const key of Object.keys(layout)) if (/^xaxis/.test(key) && !layout[key].nticks) layout[key].nticks = 6;
        layout.margin = Object.assign({}, layout.margin, {r: 18});
      }
      for (const trace of data) {
        const key = trace.legendgroup || trace.name;
        if (key in this.shown) trace.visible = this.shown[key] ? true : "legendonly";
      }
      Plotly.react(this.plot, data, layout, {responsive: true, displaylogo: false, showTips: false,
        displayModeBar: touch ? false : "hover", toImageButtonOptions: {filename: "helmstar"},
        modeBarButtons: [["toImage"], ["zoom2d", "pan2d"], ["zoomIn2d", "zoomOut2d", "resetScale2d"]]});
      this.buttons(names);
      this.entries(data);
      this.note.textContent = meta.note || "";
      this.drawn = true;
      return true;
    }
    buttons(names) {
      const box = this.node.querySelector(".views");
      box.replaceChildren();
      if (names.length < 2) return;
      for (const name of names) {
        const button = document.createElement("button");
        button.type = "button";
        button.textContent = name;
        button.setAttribute("aria-pressed", String(name === this.viewName));
        button.addEventListener("click", () => {
          this.viewName = name;
          this.draw();
          const again = [...box.children].find((other) => other.textContent === name);
          if (again) again.focus();
        });
        box.appendChild(button);
      }
    }
    entries(data) {
      this.legend.replaceChildren();
      const seen = new Set();
      for (const trace of data) {
        const key = trace.legendgroup || trace.name;
        if (!trace.name || trace.showlegend === false || seen.has(key)) continue;
        seen.add(key);
        const button = document.createElement("button");
        button.type = "button";
        const visible = trace.visible !== "legendonly" && trace.visible !== false;
        button.setAttribute("aria-pressed", String(visible));
        button.title = "Show or hide";
        button.append(swatch(trace), trace.name);
        button.addEventListener("click", () => {
          this.shown[key] = !visible;
          this.draw();
          const again = [...this.legend.children].find((other) => other.textContent === trace.name);
          if (again) again.focus();
        });
        this.legend.appendChild(button);
      }
      if (seen.size < 2) this.legend.replaceChildren();
    }
  }
  function apply(layout, changes) {
    for (const path of Object.keys(changes || {})) {
      let target = layout;
      const keys = path.split(".");
      for (const key of keys.slice(0, -1)) target = target[key] = target[key] || {};
      target[keys[keys.length - 1]] = changes[path];
    }
  }

  const figures = [...document.querySelectorAll("figure.figure")].map((node) => new Figure(node));
  function choose(source, name) {
    for (const figure of figures) {
      const same = figure === source || (figure.spec.group && figure.spec.group === source.spec.group);
      if (!same || !figure.select || ![...figure.select.options].some((option) => option.value === name)) continue;
      figure.select.value = name;
      if (figure.drawn) figure.draw();
    }
  }

  // Draw what is in sight first, then the rest one by one while the page is idle.
  const waiting = new Set(figures);
  const later = window.requestIdleCallback || ((call) => setTimeout(call, 30));
  function next() {
    const closed = (figure) => figure.node.closest("details:not([open])");
    const first = [...waiting].find((figure) => !closed(figure));
    if (first) {
      waiting.delete(first);
      first.draw();
      later(next, {timeout: 200});
    } else {
      document.documentElement.dataset.drawn = waiting.size ? "open" : "all";
    }
  }
  const watcher = new IntersectionObserver((changes) => {
    for (const change of changes) {
      const figure = figures.find((one) => one.node === change.target);
      if (change.isIntersecting && waiting.has(figure) && figure.draw()) waiting.delete(figure);
    }
  }, {rootMargin: "200px"});
  for (const figure of figures) watcher.observe(figure.node);
  later(next, {timeout: 200});
  document.querySelectorAll("details").forEach((block) => block.addEventListener("toggle", () => later(next)));

  const redraw = () => figures.forEach((figure) => figure.drawn && figure.draw());
  darkMedia.addEventListener("change", redraw);
  let timer = 0;
  window.addEventListener("resize", () => {
    clearTimeout(timer);
    timer = setTimeout(() => figures.forEach((figure) => {
      if (figure.drawn && figure.narrow() !== figure.wasNarrow) figure.draw();
    }), 150);
  });
  window.addEventListener("beforeprint", () => {
    printing = true;
    document.querySelectorAll("details").forEach((block) => { block.open = true; });
    figures.forEach((figure) => figure.draw());
  });
  window.addEventListener("afterprint", () => { printing = false; redraw(); });

  document.querySelectorAll(".copy").forEach((button) => button.addEventListener("click", async () => {
    const code = button.closest(".code").querySelector("code");
    let done = true;
    try {
      await navigator.clipboard.writeText(code.textContent);
    } catch (error) {
      getSelection().selectAllChildren(code);
      done = document.execCommand("copy");
    }
    button.textContent = done ? "Copied" : "Selected";
    setTimeout(() => { button.textContent = "Copy"; }, 1500);
  }));

  const links = new Map([...document.querySelectorAll(".contents a")].map((link) => [link.hash.slice(1), link]));
  const bar = document.querySelector(".contents");
  function mark() {
    let current = null;
    for (const [id, link] of links) {
      if (document.getElementById(id).getBoundingClientRect().top < innerHeight * 0.3 || !current) current = link;
    }
    for (const link of links.values()) {
      if (link !== current) link.removeAttribute("aria-current");
    }
    if (current && !current.hasAttribute("aria-current")) {
      current.setAttribute("aria-current", "true");
      if (bar.scrollWidth > bar.clientWidth) bar.scrollTo({left: current.offsetLeft - 40});
    }
  }
  if (links.size) {
    window.addEventListener("scroll", mark, {passive: true});
    mark();
  }
})();
