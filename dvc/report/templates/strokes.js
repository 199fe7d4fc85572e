"use strict";
/* Strokes on slices of an image. Voxels lie as in the file: the first axis of the image fastest. */
const $ = (id) => document.getElementById(id);
const about = JSON.parse($("about").textContent);
const bytes = (text) => Uint8Array.from(atob(text.trim()), (c) => c.charCodeAt(0));
const through = async (content, stream) => new Uint8Array(await new Response(new Blob([content]).stream().pipeThrough(stream)).arrayBuffer());
const step = [1, about.shape[0], about.shape[0] * about.shape[1]];
const marks = new Uint8Array(step[2] * about.shape[2]);
const radios = [...document.querySelectorAll("[name=tissue]")];
const tissues = radios.filter((one) => one.dataset.name);
const colours = [[0, 0, 0]];
for (const one of tissues) {
  one.nextElementSibling.style.background = one.dataset.colour;
  colours[one.value] = [1, 3, 5].map((at) => parseInt(one.dataset.colour.slice(at, at + 2), 16));
}
const at = about.shape.map((n) => n >> 1); /* the voxel through which all slices go */
const done = [], undone = []; /* strokes: what each voxel was before, by its place */
let values, stroke = null, saved = true;

const say = (text, wrong = false) => { $("told").textContent = text; $("told").classList.toggle("wrong", wrong); };
const tissue = () => Number(radios.find((one) => one.checked).value);

/* ---- a view: one slice, its axes, and how it is drawn ---- */
const views = about.views.map((view) => {
  const [across, down, into] = [view.across, view.down, view.through];
  const size = [about.shape[across.axis], about.shape[down.axis]], mm = [about.spacing[across.axis], about.spacing[down.axis]];
  const figure = document.createElement("figure"), head = document.createElement("header"), title = document.createElement("h2");
  const larger = document.createElement("button"), canvas = document.createElement("canvas"), row = document.createElement("label");
  const slider = document.createElement("input"), number = document.createElement("span");
  const name = view.name[0].toUpperCase() + view.name.slice(1);
  title.textContent = name + (view.tilt ? `, along image axes (tilted ${view.tilt}°)` : "");
  canvas.setAttribute("aria-label", `${name} slice`);
  canvas.dataset.plane = view.name;
  larger.type = "button"; larger.textContent = "Enlarge"; larger.className = "large-only";
  row.className = "slice"; slider.type = "range"; slider.min = 1; slider.max = about.shape[into.axis];
  slider.setAttribute("aria-label", `${name} slice number`);
  head.append(title, larger); row.append("Slice", slider, number); figure.append(head, canvas, row);
  document.querySelector("main").append(figure);
  const layer = document.createElement("canvas");
  [layer.width, layer.height] = size;
  const [to, onto] = [canvas, layer].map((one) => one.getContext("2d", { willReadFrequently: true })); /* in memory: slices come from there */
  const pixels = new ImageData(size[0], size[1]), over = new ImageData(size[0], size[1]);
  const place = (end, n) => (end.back ? about.shape[end.axis] - 1 - n : n); /* from the page to the image, and back */
  const self = { figure, size, mm, slider };
  self.index = (x, y) => { /* place of a voxel at column x and row y of the page */
    const voxel = [...at];
    voxel[across.axis] = place(across, x); voxel[down.axis] = place(down, y);
    return voxel[0] + voxel[1] * step[1] + voxel[2] * step[2];
  };
  self.fit = () => {
    const beside = views.filter((one) => one.figure.clientWidth === figure.clientWidth); /* at one scale */
    const widest = Math.max(...beside.map((one) => one.size[0] * one.mm[0])), tallest = Math.max(...beside.map((one) => one.size[1] * one.mm[1]));
    const scale = Math.min((figure.clientWidth - 20) / widest, Math.max(260, innerHeight * 0.82) / tallest), sharp = devicePixelRatio || 1;
    canvas.style.width = `${size[0] * mm[0] * scale}px`; canvas.style.height = `${size[1] * mm[1] * scale}px`;
    canvas.width = Math.round(size[0] * mm[0] * scale * sharp); canvas.height = Math.round(size[1] * mm[1] * scale * sharp);
    self.draw();
  };
  self.draw = () => {
    const white = 255 / (about.greys - 1) * Number($("bright").value), first = self.index(0, 0);
    const right = self.index(1, 0) - first, below = self.index(0, 1) - first;
    for (let y = 0, n = 0; y < size[1]; y++) {
      for (let x = 0, from = first + y * below; x < size[0]; x++, n += 4, from += right) {
        pixels.data[n] = pixels.data[n + 1] = pixels.data[n + 2] = values[from] * white;
        pixels.data[n + 3] = 255;
        const mark = marks[from], colour = colours[mark];
        over.data[n] = colour[0]; over.data[n + 1] = colour[1]; over.data[n + 2] = colour[2]; over.data[n + 3] = mark ? 190 : 0;
      }
    }
    const [w, h] = [canvas.width, canvas.height], sharp = w / parseFloat(canvas.style.width);
    for (const [data, smooth] of [[pixels, true], [over, false]]) {
      onto.putImageData(data, 0, 0);
      to.imageSmoothingEnabled = smooth;
      to.drawImage(layer, 0, 0, w, h);
    }
    to.strokeStyle = "#FFD54A"; to.lineWidth = 1.2 * sharp; /* marks where the other slices cut */
    const cut = [(place(across, at[across.axis]) + 0.5) / size[0] * w, (place(down, at[down.axis]) + 0.5) / size[1] * h];
    const tick = 0.035 * Math.min(w, h);
    to.beginPath();
    for (const [x0, y0, x1, y1] of [[cut[0], 0, cut[0], tick], [cut[0], h - tick, cut[0], h], [0, cut[1], tick, cut[1]], [w - tick, cut[1], w, cut[1]]]) { to.moveTo(x0, y0); to.lineTo(x1, y1); }
    to.stroke();
    to.font = `bold ${13 * sharp}px sans-serif`; to.fillStyle = "#fff"; to.shadowColor = "#000"; to.shadowBlur = 3 * sharp; to.textBaseline = "middle";
    const near = 6 * sharp, lead = 11 * sharp, side = (c, n) => (Math.abs(c / n - 0.5) > 0.05 ? 0.5 : 0.42) * n;
    [[near, side(cut[1], h), "left"], [w - near, side(cut[1], h), "right"], [side(cut[0], w), lead, "center"], [side(cut[0], w), h - lead, "center"]]
      .forEach(([x, y, align], n) => { to.textAlign = align; to.fillText(view.letters[n], x, y); });
    to.shadowBlur = 0;
    slider.value = place(into, at[into.axis]) + 1;
    number.textContent = `${slider.value} of ${slider.max}`;
  };
  self.go = (n) => { at[into.axis] = place(into, Math.min(Math.max(n, 0), slider.max - 1)); drawAll(); };
  self.spot = (event) => { /* column and row under the pointer, with fractions */
    const box = canvas.getBoundingClientRect();
    return [(event.clientX - box.left) / box.width * size[0] - 0.5, (event.clientY - box.top) / box.height * size[1] - 0.5];
  };
  slider.addEventListener("input", () => self.go(slider.value - 1));
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); self.go(slider.value - 1 + Math.sign(event.deltaY)); }, { passive: false });
  canvas.addEventListener("contextmenu", (event) => {
    event.preventDefault();
    const [x, y] = self.spot(event).map((n, axis) => Math.min(Math.max(Math.round(n), 0), size[axis] - 1));
    at[across.axis] = place(across, x); at[down.axis] = place(down, y);
    drawAll();
  });
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button !== 0 || stroke) return;
    canvas.setPointerCapture(event.pointerId);
    stroke = { was: new Map(), view: self, mark: tissue(), last: self.spot(event) };
    paint(stroke.last);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (stroke?.view !== self) return;
    for (const one of event.getCoalescedEvents?.() ?? [event]) paint(self.spot(one));
    paint(self.spot(event));
  });
  for (const ends of ["pointerup", "pointercancel"]) canvas.addEventListener(ends, () => { if (stroke?.view === self) finish(); });
  larger.addEventListener("click", () => {
    const grown = figure.classList.toggle("large");
    larger.textContent = grown ? "Make smaller" : "Enlarge";
    views.forEach((one) => one.fit());
    figure.scrollIntoView({ block: "nearest" });
  });
  return self;
});
const drawAll = () => views.forEach((view) => view.draw());

/* ---- strokes ---- */
const set = (index, mark) => {
  if (marks[index] === mark) return;
  if (!stroke.was.has(index)) stroke.was.set(index, marks[index]);
  marks[index] = mark;
};
/* A round brush along the line from the last spot: voxels whose centres it covers, and the one under the pointer. */
const paint = (to) => {
  const { view, last, mark } = stroke, [mx, my] = view.mm, reach = Number($("brush").value) / 2;
  const inside = (x, y) => x >= 0 && y >= 0 && x < view.size[0] && y < view.size[1];
  const from = [last[0] * mx, last[1] * my], way = [to[0] * mx - from[0], to[1] * my - from[1]], long = way[0] ** 2 + way[1] ** 2;
  const [low, high] = [0, 1].map((end) => [0, 1].map((axis) => (end ? Math.ceil(Math.max(last[axis], to[axis]) + reach / view.mm[axis]) : Math.floor(Math.min(last[axis], to[axis]) - reach / view.mm[axis]))));
  for (let y = low[1]; y <= high[1]; y++) {
    for (let x = low[0]; x <= high[0]; x++) {
      const off = [x * mx - from[0], y * my - from[1]];
      const along = long ? Math.min(Math.max((off[0] * way[0] + off[1] * way[1]) / long, 0), 1) : 0;
      if (inside(x, y) && Math.hypot(off[0] - along * way[0], off[1] - along * way[1]) <= reach) set(view.index(x, y), mark);
    }
  }
  const steps = Math.ceil(2 * Math.hypot(to[0] - last[0], to[1] - last[1])) || 1;
  for (let n = 0; n <= steps; n++) {
    const [x, y] = [0, 1].map((axis) => Math.round(last[axis] + (to[axis] - last[axis]) * n / steps));
    if (inside(x, y)) set(view.index(x, y), mark);
  }
  stroke.last = to;
  view.draw();
};
const finish = () => {
  if (stroke.was.size) { done.push(stroke.was); undone.length = 0; }
  stroke = null;
  changed();
};
const swap = (from, to) => {
  if (!from.length || stroke) return;
  const was = from.pop();
  for (const [index, mark] of was) { was.set(index, marks[index]); marks[index] = mark; }
  to.push(was);
  changed();
};
const counted = () => {
  const counts = new Array(256).fill(0);
  for (const mark of marks) counts[mark]++;
  const told = tissues.filter((one) => counts[one.value]).map((one) => `${one.dataset.name} ${counts[one.value]}`);
  return told.length ? `Voxels marked: ${told.join(", ")}.` : "";
};
const changed = (what = "") => {
  const told = counted();
  saved = !told;
  $("undo").disabled = !done.length; $("redo").disabled = !undone.length; $("save").disabled = !told;
  say(`${what}${what && told ? " " : ""}${told || (what ? "" : "No strokes yet.")}`);
  drawAll();
};

/* ---- files ---- */
const save = async () => {
  const file = await through(new Blob([bytes($("header").textContent), marks]), new CompressionStream("gzip"));
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([file], { type: "application/gzip" }));
  link.download = about.file;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
  saved = true;
  say(`Saved as ${about.file}, in the folder of your downloads. ${counted()}`);
};
const open = async (file) => {
  const wanted = bytes($("header").textContent), refuse = `${file.name} was not saved on this page, or for another image. Nothing was changed.`;
  try {
    let content = new Uint8Array(await file.arrayBuffer());
    if (content[0] === 31 && content[1] === 139) content = await through(content, new DecompressionStream("gzip"));
    const same = content.length === wanted.length + marks.length && wanted.every((byte, n) => byte === content[n]);
    if (!same) return say(refuse, true);
    stroke = { was: new Map() };
    content.subarray(wanted.length).forEach((mark, index) => set(index, mark));
    finish();
    saved = true;
  } catch { say(refuse, true); }
};

$("undo").addEventListener("click", () => swap(done, undone));
$("redo").addEventListener("click", () => swap(undone, done));
$("save").addEventListener("click", save);
$("open").addEventListener("click", () => $("file").click());
$("file").addEventListener("change", () => { if ($("file").files.length) open($("file").files[0]); $("file").value = ""; });
const brush = () => { $("width").textContent = `${Number($("brush").value).toFixed(1)} mm`; };
$("brush").addEventListener("input", brush);
$("bright").addEventListener("input", drawAll);
addEventListener("resize", () => views.forEach((view) => view.fit()));
addEventListener("keydown", (event) => {
  const key = event.key.toLowerCase();
  if (event.ctrlKey || event.metaKey) {
    if (key === "z" || key === "y") { event.preventDefault(); key === "y" || event.shiftKey ? swap(undone, done) : swap(done, undone); }
    return;
  }
  const chosen = radios.find((one) => one.value === (key === "e" ? "0" : key));
  if (chosen) chosen.checked = true;
});
addEventListener("beforeunload", (event) => { if (!saved) event.preventDefault(); });
brush();
if (matchMedia("(max-width: 40rem)").matches) document.querySelector("details").open = false;
through(bytes($("image").textContent), new DecompressionStream("gzip")).then((content) => {
  values = content;
  $("image").remove();
  views.forEach((view) => view.fit());
  changed();
  document.body.dataset.state = "ready";
}).catch((problem) => say(`This browser cannot unpack the image (${problem}). Use a newer one.`, true));
