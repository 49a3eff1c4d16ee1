"use strict";

// Tables that sort. Without this script they are plain tables.
{
  const words = new Intl.Collator("en", { numeric: true });

  /** What a reader sees in a cell; minus signs as programs write them, no thousands separators. */
  const textOf = (cell) => {
    const copy = cell.cloneNode(true);
    copy.querySelectorAll("[data-mark]").forEach((mark) => mark.remove());
    const text = [...copy.childNodes].map((node) => node.textContent).join(" ");
    return text.replace(/−/g, "-").replace(/(\d),(?=\d{3}(?!\d))/g, "$1").trim();
  };
  const isBlank = (text) => /^[–—-]?$/.test(text);
  const isNumeric = (text) => /^[#~≈≤≥<>(×\s]*[+-]?(\d|∞)/.test(text);

  /** All numbers of a cell: the value first, then the ends of its interval. Words are beyond all. */
  const numbersIn = (text) => {
    const found = isNumeric(text) ? text.match(/(?<![\w.])[+-]?(\d+(\.\d+)?(e[+-]?\d+)?|∞)/g) : ["∞"];
    return found.map((one) => (one.endsWith("∞") ? (one[0] === "-" ? -Infinity : Infinity) : +one));
  };
  const compareLists = (a, b) => {
    for (let i = 0; i < Math.min(a.length, b.length); i++) {
      if (a[i] !== b[i]) return a[i] < b[i] ? -1 : 1;
    }
    return a.length - b.length;
  };

  /** The rows in the order of a column; blank cells stay at the end. */
  const sorted = (rows, column, sign) => {
    const texts = new Map(rows.map((row) => [row, textOf(row.cells[column])]));
    const told = rows.filter((row) => !isBlank(texts.get(row)));
    const numeric = told.filter((row) => isNumeric(texts.get(row))).length * 2 > told.length;
    const keys = new Map(told.map((row) => [row, numeric ? numbersIn(texts.get(row)) : texts.get(row)]));
    const compare = numeric ? compareLists : words.compare;
    told.sort((a, b) => sign * compare(keys.get(a), keys.get(b)));
    return [...told, ...rows.filter((row) => isBlank(texts.get(row)))];
  };

  for (const table of document.querySelectorAll(".table table")) {
    const body = table.tBodies[0];
    const original = [...body.rows];
    if (original.length < 2) continue;
    const headers = [...table.tHead.rows[0].cells];
    headers.forEach((header, column) => {
      const button = document.createElement("button");
      button.type = "button";
      button.append(...header.childNodes);
      header.append(button);
      button.addEventListener("click", () => {
        const next = { null: "ascending", ascending: "descending" }[header.getAttribute("aria-sort")];
        headers.forEach((one) => one.removeAttribute("aria-sort"));
        if (next) header.setAttribute("aria-sort", next);
        body.append(...(next ? sorted(original, column, next === "ascending" ? 1 : -1) : original));
      });
    });
  }
}

// Figures that open large. Without this script they are plain images.
{
  const LARGEST = 16;
  const dialog = document.createElement("dialog");
  dialog.className = "zoom";
  dialog.setAttribute("aria-labelledby", "zoom-title");
  dialog.innerHTML = `
    <div class="bar"><h2 id="zoom-title"></h2>
    <button type="button" data-do="-" aria-label="Smaller (key −)">−</button>
    <button type="button" data-do="+" aria-label="Larger (key +)">+</button>
    <button type="button" data-do="0" aria-label="The whole figure (key 0)">Fit</button>
    <button type="button" data-do="Escape" aria-label="Close (key Esc)">✕</button></div>
    <div class="stage" tabindex="0" autofocus><img draggable="false"></div>`;
  const [title, stage, image] = ["h2", ".stage", "img"].map((name) => dialog.querySelector(name));
  const pointers = new Map();
  let [scale, x, y] = [1, 0, 0]; // of the image, 1 where all of it is seen; where its corner lies

  /** Put the image where it belongs: centred where there is room, else without a gap at an edge. */
  const place = () => {
    if (!image.naturalWidth) return; // not there yet
    const { clientWidth: width, clientHeight: height } = stage;
    const fit = Math.min(width / image.naturalWidth, height / image.naturalHeight);
    const [w, h] = [image.naturalWidth * fit * scale, image.naturalHeight * fit * scale];
    const within = (at, size, room) =>
      size <= room ? (room - size) / 2 : Math.min(0, Math.max(room - size, at));
    x = within(x, w, width);
    y = within(y, h, height);
    image.style.width = `${w}px`;
    image.style.transform = `translate(${x}px, ${y}px)`;
  };
  const fitAll = () => { scale = 1; x = y = 0; place(); };
  const move = (dx, dy) => { x += dx; y += dy; place(); };

  /** Zoom, with the point of the stage (by default its middle) staying where it is. */
  const zoom = (factor, px = stage.clientWidth / 2, py = stage.clientHeight / 2) => {
    const old = scale;
    scale = Math.min(LARGEST, Math.max(1, scale * factor));
    x = px - ((px - x) * scale) / old;
    y = py - ((py - y) * scale) / old;
    place();
  };
  const within = (event) => {
    const box = stage.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };

  const actions = {
    "+": () => zoom(1.4), "=": () => zoom(1.4), "-": () => zoom(1 / 1.4), 0: fitAll,
    ArrowLeft: () => move(60, 0), ArrowRight: () => move(-60, 0),
    ArrowUp: () => move(0, 60), ArrowDown: () => move(0, -60),
    Escape: () => dialog.close(),
  };
  dialog.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || !(event.key in actions)) return;
    event.preventDefault();
    actions[event.key]();
  });
  dialog.addEventListener("click", (event) => actions[event.target.dataset.do]?.());
  stage.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.002)), ...within(event));
  }, { passive: false });
  stage.addEventListener("dblclick", (event) => zoom(2, ...within(event)));

  stage.addEventListener("pointerdown", (event) => {
    stage.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, within(event));
  });
  stage.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = within(event);
    const other = [...pointers].find(([id]) => id !== event.pointerId)?.[1];
    pointers.set(event.pointerId, now);
    if (!other) return move(now[0] - before[0], now[1] - before[1]);
    const apart = (one) => Math.hypot(one[0] - other[0], one[1] - other[1]);
    zoom(apart(now) / Math.max(apart(before), 1), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
  });
  for (const end of ["pointerup", "pointercancel"]) {
    stage.addEventListener(end, (event) => pointers.delete(event.pointerId));
  }
  window.addEventListener("resize", () => { if (dialog.open) place(); });

  let opener = null;
  dialog.addEventListener("close", () => { pointers.clear(); opener.focus(); });
  for (const figure of document.querySelectorAll("figure")) {
    const picture = figure.querySelector(".card img");
    const name = figure.querySelector("h3").textContent;
    const button = document.createElement("button");
    button.type = "button";
    button.title = "Open large";
    button.setAttribute("aria-label", `Open large: ${name}. ${picture.alt}`);
    picture.replaceWith(button);
    button.append(picture);
    button.addEventListener("click", () => {
      opener = button;
      title.textContent = name;
      image.alt = picture.alt;
      image.src = picture.src;
      dialog.showModal();
      image.decode().then(fitAll);
    });
  }
  document.body.append(dialog);
}
