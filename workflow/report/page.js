"use strict";
(() => {
  const root = document.documentElement;
  root.classList.add("js");
  const all = (selector, within = document) => [...within.querySelectorAll(selector)];
  const byId = (id) => document.getElementById(id);
  const element = (name, attributes = {}, ...children) => {
    const made = document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    made.append(...children);
    return made;
  };

  // Theme: the system's until the button is pressed; the choice is kept where the browser lets a file keep something.
  const dark = () => (root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches);
  const theme = byId("theme");
  const showTheme = () => { theme.textContent = dark() ? "Light" : "Dark"; theme.setAttribute("aria-label", `Use the ${dark() ? "light" : "dark"} theme`); };
  try { if (localStorage.iifTheme) root.dataset.theme = localStorage.iifTheme; } catch { /* no storage */ }
  theme.addEventListener("click", () => {
    root.dataset.theme = dark() ? "light" : "dark";
    try { localStorage.iifTheme = root.dataset.theme; } catch { /* no storage */ }
    showTheme();
  });
  showTheme();

  // Photograph over re-rendering.
  for (const slider of all(".compare input")) {
    slider.addEventListener("input", () => {
      slider.parentElement.style.setProperty("--at", `${slider.value}%`);
      slider.setAttribute("aria-valuetext", `${slider.value} % photograph`);
    });
  }

  // Explanations: the text of the entry that a link points to, on hover and on focus.
  const tip = byId("tip");
  let shown = null;
  const hide = () => { if (shown) { tip.hidePopover(); shown = null; } };
  const show = (link) => {
    const entry = document.querySelector(link.getAttribute("href"));
    if (!entry || !tip.showPopover || shown === link) return;
    hide();
    tip.textContent = entry.textContent;
    tip.showPopover();
    shown = link;
    placeTip();
  };
  const placeTip = () => {
    if (!shown) return;
    const at = shown.getBoundingClientRect(), box = tip.getBoundingClientRect();
    tip.style.left = `${Math.max(8, Math.min(at.left, innerWidth - box.width - 8))}px`;
    tip.style.top = `${at.bottom + box.height + 8 < innerHeight ? at.bottom + 6 : Math.max(8, at.top - box.height - 6)}px`;
  };
  for (const link of all("a.tip")) {
    link.addEventListener("mouseenter", () => show(link));
    link.addEventListener("focus", () => show(link));
    link.addEventListener("mouseleave", hide);
    link.addEventListener("blur", hide);
    link.addEventListener("click", (event) => { event.preventDefault(); show(link); });
  }
  addEventListener("scroll", placeTip, { passive: true, capture: true });  // focus may scroll the number into view
  addEventListener("keydown", (event) => { if (event.key === "Escape") hide(); });

  const text = (cell) => cell.textContent.trim().toLowerCase();
  for (const table of all("table.sortable")) sortable(table, table.tBodies[0]);  // tables.js
  const find = byId("find");
  if (find) {
    const rows = [...byId("objects").tBodies[0].rows];
    find.addEventListener("input", () => {
      const words = find.value.trim().toLowerCase().split(/\s+/);
      let left = 0;
      for (const row of rows) {
        row.hidden = !words.every((word) => text(row).includes(word));
        left += !row.hidden;
      }
      byId("found").textContent = find.value.trim() ? `${left} of ${rows.length}` : "";
    });
  }

  // Commands to the clipboard.
  for (const pre of all("pre")) {
    const words = pre.textContent;
    const button = element("button", { type: "button", class: "copy", "aria-label": `Copy: ${words}` }, "Copy");
    button.addEventListener("click", async () => {
      try {
        await navigator.clipboard.writeText(words);
      } catch {
        getSelection().selectAllChildren(pre.querySelector("code"));
        document.execCommand("copy");
      }
      button.textContent = "Copied";
    });
    pre.prepend(button);
  }

  // The section that is read, in the bar.
  const links = new Map(all("nav a").map((link) => [link.getAttribute("href").slice(1), link]));
  const watcher = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (!entry.isIntersecting) continue;
      for (const link of links.values()) link.removeAttribute("aria-current");
      const link = links.get(entry.target.id);
      link.setAttribute("aria-current", "true");
      link.parentElement.scrollLeft = link.offsetLeft - (link.parentElement.clientWidth - link.offsetWidth) / 2; // on a phone
    }
  }, { rootMargin: "-20% 0px -75% 0px" });
  for (const id of links.keys()) watcher.observe(byId(id));

  // Closed parts are printed too.
  let closed = [];
  addEventListener("beforeprint", () => { closed = all("details:not([open])"); for (const part of closed) part.open = true; });
  addEventListener("afterprint", () => { for (const part of closed) part.open = false; });

  // ---------------------------------------------------------------------------------------------------- pictures, large
  const palettes = JSON.parse(byId("palettes").textContent);
  const places = Object.fromEntries(Object.entries(palettes).map(([name, colours]) => [name, new Map(colours.map((c, i) => [c, i / (colours.length - 1)]))]));
  const pixels = new Map();
  const pixelsOf = (image) => {
    if (!pixels.has(image.src)) {
      const canvas = element("canvas");
      canvas.width = image.naturalWidth;
      canvas.height = image.naturalHeight;
      const context = canvas.getContext("2d", { willReadFrequently: true });
      context.drawImage(image, 0, 0);
      pixels.set(image.src, context.getImageData(0, 0, canvas.width, canvas.height));
    }
    return pixels.get(image.src);
  };
  const digits = (value) => Number(value.toPrecision(3)).toString();
  const decoded = (v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
  // What the colour of a pixel stands for, as text: the inverse of workflow/report/pictures.py.
  const valueAt = (image, u, v) => {
    const data = pixelsOf(image);
    const x = Math.min(data.width - 1, Math.floor(u * data.width)), y = Math.min(data.height - 1, Math.floor(v * data.height));
    const rgb = [...data.data.slice(4 * (y * data.width + x), 4 * (y * data.width + x) + 3)];
    const { kind, unit } = image.dataset, low = Number(image.dataset.low), high = Number(image.dataset.high);
    if (kind === "sensor") return `${rgb.map((c) => (c / 255).toFixed(3)).join(", ")} ${unit}`;
    if (kind === "srgb") return `${rgb.map((c) => `${c === 255 ? "≥ " : ""}${digits(decoded(c / 255) / high)}`).join(", ")} ${unit}`;
    if (kind === "grey") return `${digits(rgb[0] / 255)} ${unit}`;
    if (places[kind]) {
      const place = places[kind].get(`#${rgb.map((c) => c.toString(16).padStart(2, "0")).join("")}`);
      if (place === undefined) return "outside";
      return `${place === 1 ? "≥ " : ""}${digits(low + place * (high - low))} ${unit}`;
    }
    return "–";
  };

  const viewer = byId("viewer");
  const holder = viewer.querySelector(".panels");
  let panels = [], zoom = 1, centre = [0.5, 0.5], point = null;

  const place = () => {
    const half = 0.5 / zoom;
    centre = centre.map((c) => Math.min(1 - half, Math.max(half, c)));
    for (const { stage, image, cross, output, source } of panels) {
      const width = stage.clientWidth, height = stage.clientHeight;
      if (!image.naturalWidth || !width) continue;
      const fit = Math.min(width / image.naturalWidth, height / image.naturalHeight) * zoom;
      const w = image.naturalWidth * fit, h = image.naturalHeight * fit;
      const left = width / 2 - centre[0] * w, top = height / 2 - centre[1] * h;
      image.style.width = `${w}px`;
      image.style.height = `${h}px`;
      image.style.transform = `translate(${left}px, ${top}px)`;
      cross.hidden = !point;
      if (point) {
        cross.style.left = `${left + point[0] * w}px`;
        cross.style.top = `${top + point[1] * h}px`;
        output.textContent = valueAt(source, ...point);
      } else {
        output.textContent = source.dataset.unit;
      }
    }
  };
  const at = (stage, image, event) => {
    const box = image.getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  };
  const zoomed = (factor, around = centre) => {
    const next = Math.min(40, Math.max(1, zoom * factor));
    centre = centre.map((c, i) => around[i] + ((c - around[i]) * zoom) / next);
    zoom = next;
    place();
  };
  const whole = () => { zoom = 1; centre = [0.5, 0.5]; place(); };

  const panelOf = (choices, chosen) => {
    const select = element("select", { "aria-label": "Picture" }, ...choices.map((c, i) => element("option", { value: i }, c.dataset.name)));
    const image = element("img", { alt: "", draggable: "false" }), cross = element("div", { class: "cross" });
    const stage = element("div", { class: "stage", tabindex: "0", role: "group", "aria-label": "Picture; arrows move the point whose values are shown" }, image, cross);
    const output = element("output", { "aria-live": "polite" });
    const panel = { stage, image, cross, output, source: choices[chosen] };
    const put = () => { panel.source = choices[Number(select.value)]; image.src = panel.source.src; image.alt = panel.source.alt; image.decode().then(place, place); };
    select.value = String(chosen);
    select.addEventListener("change", put);
    put();
    const fingers = new Map();
    stage.addEventListener("pointerdown", (event) => { stage.setPointerCapture(event.pointerId); fingers.set(event.pointerId, event); });
    for (const end of ["pointerup", "pointercancel"]) stage.addEventListener(end, (event) => fingers.delete(event.pointerId));
    stage.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      const where = at(stage, image, event);
      if (before) {
        const others = [...fingers.values()].filter((f) => f.pointerId !== event.pointerId);
        const box = image.getBoundingClientRect();
        if (others.length) {
          const far = (a) => Math.hypot(a.clientX - others[0].clientX, a.clientY - others[0].clientY);
          zoomed(far(event) / Math.max(1, far(before)), where);
        }
        centre = [centre[0] - (event.clientX - before.clientX) / box.width, centre[1] - (event.clientY - before.clientY) / box.height];
        fingers.set(event.pointerId, event);
      }
      point = where.every((c) => c >= 0 && c < 1) ? where : point;
      place();
    });
    stage.addEventListener("wheel", (event) => { event.preventDefault(); zoomed(Math.exp(-event.deltaY / 300), at(stage, image, event)); }, { passive: false });
    stage.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
      if (step) {
        event.preventDefault();
        if (event.shiftKey) {
          centre = centre.map((c, i) => c + (0.1 * step[i]) / zoom);
        } else {
          const size = [image.naturalWidth, image.naturalHeight];
          point = (point ?? centre).map((c, i) => Math.min(1 - 0.5 / size[i], Math.max(0.5 / size[i], (Math.floor(c * size[i]) + 0.5 + step[i]) / size[i])));
        }
        place();
      } else if (event.key === "+" || event.key === "=") zoomed(1.5, point ?? centre);
      else if (event.key === "-") zoomed(1 / 1.5, point ?? centre);
      else if (event.key === "0") whole();
    });
    holder.append(element("div", { class: "panel" }, select, stage, output));
    return panel;
  };

  const openViewer = (clicked) => {
    const view = clicked.dataset.view, choices = [];
    for (const image of all("#maps img[data-view], img[data-view]")) {
      if (image.dataset.view === view && !choices.some((c) => c.dataset.name.split(": ")[1] === image.dataset.name.split(": ")[1] && c.src === image.src)) choices.push(image);
    }
    const named = (name) => choices.findIndex((c) => c.dataset.name.endsWith(`: ${name}`));
    const wanted = [choices.indexOf(clicked), named("photograph"), named("re-rendering"), named("albedo")];
    if (wanted[0] < 0) wanted[0] = choices.findIndex((c) => c.src === clicked.src);
    const chosen = [...new Set(wanted.filter((i) => i >= 0))].slice(0, 3);
    holder.replaceChildren();
    byId("viewer-title").textContent = `View ${view}`;
    zoom = 1; centre = [0.5, 0.5]; point = null;
    viewer.showModal();
    panels = [];
    for (const i of chosen) panels.push(panelOf(choices, i));
    panels[0].stage.focus();
  };
  viewer.querySelector(".toolbar").addEventListener("click", (event) => {
    const doing = event.target.dataset.do;
    if (doing === "close") viewer.close();
    else if (doing === "all") whole();
    else if (doing) zoomed(doing === "in" ? 1.5 : 1 / 1.5, point ?? centre);
  });
  addEventListener("resize", place);

  for (const image of all(".map img")) {
    const button = element("button", { type: "button", class: "open", "aria-label": `Enlarge ${image.alt}` });
    image.before(button);
    button.append(image);
    button.addEventListener("click", () => openViewer(image));
  }
  for (const caption of all(".compare figcaption")) {
    const image = caption.parentElement.querySelector(".over img");
    const button = element("button", { type: "button", "aria-label": `Enlarge view ${image.dataset.view}` }, "Enlarge");
    button.addEventListener("click", () => openViewer(image));
    caption.append(" ", button);
  }
})();
