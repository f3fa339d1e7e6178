"use strict";
// Draws the report from the JSON in #data. All text of the runs goes in as text nodes, never as markup.
const { made, runs, settings, watched } = JSON.parse(document.getElementById("data").textContent);
// what the runs measure, each once, and what they count
const measures = [...new Map(runs.flatMap(run => run.measures).map(one => [one.key, one])).values()];
const unit = runs.every(run => run.unit === runs[0].unit) ? runs[0].unit : "steps";
const where = measures[0].where ? ` ${measures[0].where}` : "";
const page = document.getElementById("page");
const VIRIDIS = ["440154", "482878", "3e4989", "31688e", "26828e", "1f9e89", "35b779", "6ece58", "b5de2b", "fde725"];
const SLOTS = 6; // colours; after them lines are dashed

function fill(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (value !== null && value !== false) node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children.filter(child => child !== null));
  return node;
}
const html = (tag, attributes = {}, ...children) => fill(document.createElement(tag), attributes, children);
const svg = (tag, attributes = {}, ...children) =>
  fill(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);
const colour = slot => `--c: var(--c${slot % SLOTS})`;
const dash = slot => ["", "7 4", "2 3", "10 3 2 3"][Math.floor(slot / SLOTS) % 4] || null;
const key = slot => html("i", { class: "key", style: `${colour(slot)}; border-color: var(--c${slot % SLOTS}); `
  + `border-top-style: ${dash(slot) ? "dashed" : "solid"}` });
const numbers = list => list.filter(value => value !== null && value !== undefined);

// Numbers as words

function compact(value) {
  const size = Math.abs(value);
  if (size === 0) return "0";
  if (size >= 1e6) return `${+(value / 1e6).toPrecision(3)} M`.replace("-", "−");
  if (size >= 1e4) return `${+(value / 1e3).toPrecision(3)} k`.replace("-", "−");
  if (size < 1e-3) return value.toExponential(1).replace("e-", "e−").replace(/^-/, "−");
  return `${size >= 1e3 ? Math.round(value) : +value.toPrecision(3)}`.replace("-", "−");
}
const plural = (count, word) => `${count} ${word}${count === 1 ? "" : "s"}`;
function duration(seconds) {
  if (seconds < 60) return `${Math.round(seconds)} s`;
  const minutes = Math.round(seconds / 60);
  return minutes < 60 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}
function interval([mean, low, high]) {
  const short = value => (value === null ? "–" : String(+value.toPrecision(4)));
  return low === null ? short(mean) : `${short(mean)} [${short(low)}, ${short(high)}]`;
}
function share(values) {
  const [mean, low, high] = values.map(value => value?.toFixed(2));
  return [html("strong", {}, mean), low === undefined ? null : html("small", {}, ` [${low}, ${high}]`)];
}
function timeUnit(longest) {
  if (longest < 300) return { label: "wall-clock, s", factor: 1 };
  return longest < 3 * 3600 ? { label: "wall-clock, min", factor: 1 / 60 } : { label: "wall-clock, h", factor: 1 / 3600 };
}
function ticks(low, high, wanted) {
  const raw = (high - low) / Math.max(wanted, 1);
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map(factor => factor * power).find(size => size >= raw * 0.999);
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + step * 1e-9; i++) found.push(i * step);
  return found;
}

// Curves

// `make` returns { series, x: label, y: label, low, high, height }; a series has x, y and, if wanted, low, high, seeds,
// area (fill between low and high). It is called again for `redraw` and whenever the width changes.
function chart(host, make) {
  host.classList.add("chart");
  let width = 0;
  function draw() {
    const spec = make();
    const shown = spec.series.filter(one => numbers(one.y).length);
    const height = spec.height || 300, left = 52, right = 10, top = 8, bottom = 40;
    const all = shown.flatMap(one => numbers([...one.y, ...(one.low || []), ...(one.high || []), ...(one.seeds || []).flat()]));
    let [low, high] = [spec.low ?? Math.min(...all), spec.high ?? Math.max(...all)];
    if (!all.length) return host.replaceChildren(html("p", { class: "note" }, spec.empty || "No value yet."));
    if (low === high) [low, high] = [low - (Math.abs(low) || 1) / 2, high + (Math.abs(high) || 1) / 2];
    const last = Math.max(...shown.map(one => one.x.at(-1))) || 1;
    const at = x => left + (x / last) * (width - left - right);
    const up = y => height - bottom - ((y - low) / (high - low)) * (height - top - bottom);
    const picture = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `${spec.y} over ${spec.x}` });
    for (const y of ticks(low, high, (height - top - bottom) / (spec.bare ? 30 : 45))) {
      picture.append(
        svg("line", { class: "gridline", x1: left, x2: width - right, y1: up(y), y2: up(y) }),
        svg("text", { x: left - 6, y: up(y) + 4, "text-anchor": "end" }, compact(y)));
    }
    for (const x of ticks(0, last, (width - left - right) / 85)) {
      const anchor = at(x) > width - 30 ? "end" : "middle";
      picture.append(svg("text", { x: at(x) + (anchor === "end" ? 8 : 0), y: height - bottom + 17, "text-anchor": anchor }, compact(x)));
    }
    picture.append(
      svg("line", { class: "gridline", x1: left, x2: width - right, y1: height - bottom, y2: height - bottom }),
      svg("text", { x: (left + width - right) / 2, y: height - 4, "text-anchor": "middle" }, spec.x));
    if (spec.y && !spec.bare) {
      const middle = (height - bottom + top) / 2;
      picture.append(svg("text", { x: 12, y: middle, "text-anchor": "middle", transform: `rotate(-90 12 ${middle})` }, spec.y));
    }
    const line = (x, y) => {
      let path = "", on = false;
      x.forEach((value, i) => {
        if (y[i] === null) { on = false; return; }
        path += `${on ? "L" : "M"}${at(value).toFixed(1)} ${up(y[i]).toFixed(1)}`;
        on = true;
      });
      return path;
    };
    for (const one of shown) {
      const group = svg("g", { style: colour(one.slot) });
      const ends = one.x.map((_, i) => i).filter(i => one.low && one.low[i] !== null && one.high[i] !== null);
      if (ends.length > 1) {
        const pick = list => ends.map(i => list[i]);
        const back = line(pick(one.x).reverse(), pick(one.low).reverse()).replace("M", "L");
        group.append(svg("path", { class: one.area ? "area" : "band", d: line(pick(one.x), pick(one.high)) + back + "Z" }));
      }
      for (const seed of one.seeds || []) group.append(svg("path", { class: "seed", d: line(one.x, seed) }));
      if (!one.area) group.append(svg("path", { class: "curve", d: line(one.x, one.y), "stroke-dasharray": dash(one.slot) }));
      if (numbers(one.y).length < 2) {
        const i = one.y.findIndex(y => y !== null);
        group.append(svg("circle", { class: "dot", cx: at(one.x[i]), cy: up(one.y[i]), r: 3.5 }));
      }
      picture.append(group);
    }
    const rule = svg("line", { class: "rule", y1: top, y2: height - bottom, visibility: "hidden" });
    picture.append(rule);
    const tip = html("div", { class: "tip", hidden: true });
    function point(event) {
      const box = picture.getBoundingClientRect();
      const x = Math.min(Math.max(((event.clientX - box.left) * (width / box.width) - left) / (width - left - right), 0), 1) * last;
      const lines = shown.map(one => {
        const i = one.x.reduce((best, value, j) => (Math.abs(value - x) < Math.abs(one.x[best] - x) ? j : best), 0);
        if (one.y[i] === null || one.x.at(-1) < x - last * 0.02) return null;
        const range = one.low && !one.area && one.low[i] !== null ? ` [${compact(one.low[i])}, ${compact(one.high[i])}]` : "";
        return html("div", {}, key(one.slot), `${one.name}: ${compact(one.y[i])}${range}`);
      });
      rule.setAttribute("x1", at(x));
      rule.setAttribute("x2", at(x));
      rule.setAttribute("visibility", "visible");
      tip.hidden = false;
      tip.replaceChildren(html("div", { class: "soft" }, `${compact(x)} ${spec.x}`.replace(/ (.*), (\w+)$/, " $2")), ...lines.filter(Boolean));
      const beside = at(x) * (box.width / width);
      tip.style.top = "8px";
      tip.style.left = beside > box.width / 2 ? "" : `${beside + 10}px`;
      tip.style.right = beside > box.width / 2 ? `${box.width - beside + 10}px` : "";
    }
    function leave() {
      tip.hidden = true;
      rule.setAttribute("visibility", "hidden");
    }
    picture.addEventListener("pointermove", point);
    picture.addEventListener("pointerdown", point);
    picture.addEventListener("pointerleave", leave);
    host.replaceChildren(picture, tip);
  }
  new ResizeObserver(() => {
    const now = Math.round(host.clientWidth);
    if (now && now !== width) { width = now; draw(); }
  }).observe(host);
  return { redraw: () => width && draw() };
}

// x values of a run in what `clock` says: "env_steps" or "wall_s"
function clocked(table, clock) {
  const unit = timeUnit(Math.max(...runs.map(run => run.facts.wall_s)));
  return clock === "env_steps" ? table.env_steps : table.wall_s.map(seconds => seconds * unit.factor);
}
const clockLabel = clock =>
  clock === "env_steps" ? unit : timeUnit(Math.max(...runs.map(run => run.facts.wall_s))).label;

function choice(name, options, onchange) {
  const group = html("fieldset", { "aria-label": name });
  options.forEach(([value, label], i) => group.append(html("label", {},
    html("input", { type: "radio", name, value, checked: i === 0, onchange: () => onchange(value) }), html("span", {}, label))));
  return group;
}
const legend = () => (runs.length === 1 ? null : html("div", { class: "legend" },
  ...runs.map((run, slot) => html("span", {}, key(slot), run.name))));
function section(id, title, lead, ...children) {
  page.append(html("section", { id }, html("h2", {}, title), lead ? html("p", { class: "soft" }, lead) : null,
    ...children.filter(Boolean)));
}
function table(head, rows, attributes = {}) {
  return html("div", { class: "scroll" }, html("table", attributes,
    html("thead", {}, html("tr", {}, ...head.map(cell => html("th", { scope: "col" }, cell)))),
    html("tbody", {}, ...rows.map(cells => html("tr", {}, ...cells.map((cell, i) =>
      html("td", { "data-name": head[i] }, ...[cell].flat().filter(part => part !== null))))))));
}

// Sections

function opening() {
  const tasks = [...new Set(runs.map(run => run.task))].join(", ");
  const withRegions = runs.some(run => run.facts.regions !== null);
  document.title = `${runs.length === 1 ? runs[0].name : plural(runs.length, "run")} · STAR report`;
  page.append(html("header", {},
    html("h1", {}, runs.length > 3 ? plural(runs.length, "run") : runs.map(run => run.name).join(", ")),
    html("p", { class: "soft" }, `${tasks} · ${plural(runs.length, "run")} · ${made.date}`,
      watched ? html("span", {}, " · ", html("b", { id: "live" }, "training, renewed as it goes")) : null)));
  const rows = runs.map(({ name, seeds, facts }, slot) => {
    const done = facts.env_steps >= facts.total_env_steps;
    return [
      [key(slot), name],
      ...measures.map(({ key, share: isShare }) =>
        facts.measured[key] ? (isShare ? share : interval)(facts.measured[key]) : "–"),
      `${seeds.length}`,
      [compact(facts.env_steps), done ? null : html("small", {}, ` of ${compact(facts.total_env_steps)}`)],
      duration(facts.wall_s),
      compact(facts.env_steps_per_s),
      ...(withRegions ? [facts.regions === null ? "–" : compact(facts.regions)] : []),
    ];
  });
  page.append(table(["run", ...measures.map(one => one.label), "seeds", `${unit} per seed`, "wall-clock",
    `${unit}/s`, ...(withRegions ? ["regions"] : [])], rows, { class: "runs" }));
  page.append(html("p", { class: "note" }, `${measures.map(one => one.label).join(", ")}: in the last evaluation${where}, mean over `
    + `seeds with the 95 % interval of that mean (Student's t). ${unit}/s: of all seeds together, median of the epochs.`));
}

function evaluations() {
  const chosen = { measure: measures[0].key, clock: "env_steps", seeds: false };
  const host = html("div");
  const drawn = chart(host, () => {
    const measure = measures.find(one => one.key === chosen.measure);
    return {
      series: runs.map((run, slot) => {
        const found = run.evaluations[chosen.measure] || { mean: [], low: [], high: [], seeds: [] };
        const { mean, low, high, seeds } = found;
        return { name: run.name, slot, x: clocked(run.evaluations, chosen.clock), y: mean, low, high,
          seeds: chosen.seeds && seeds.length > 1 ? seeds : [] };
      }),
      x: clockLabel(chosen.clock), y: measure.share ? "share of episodes" : measure.label, ...(measure.share ? { low: 0, high: 1 } : {}),
      height: 340, empty: "No evaluation yet.",
    };
  });
  const set = name => value => { chosen[name] = value; drawn.redraw(); };
  section("evaluations", `Evaluations${where}`,
    "Mean over seeds; the band is the 95 % interval of that mean (Student's t).",
    html("div", { class: "controls" },
      choice("measure", measures.map(({ key, label }) => [key, label]), set("measure")),
      choice("clock", [["env_steps", unit], ["wall_s", "wall-clock"]], set("clock")),
      html("label", {}, html("input", { type: "checkbox", id: "each", onchange: event => set("seeds")(event.target.checked) }), " each seed")),
    legend(), host);
}

const COLOURINGS = {
  chosen: "chosen as target, % of the Commander's choices",
  visited: "visited, % of the Commander's decisions begun there",
  value: "Commander's value towards the test goal",
  drawn: "practised, % of SGIM's choices",
  competence: "SGIM's competence",
};
const ARROWS = {
  none: "no arrows",
  plan: "the Commander's plan to the goal",
  reaches: "reachability graph: REACHES",
  misses: "shown unreachable: MISSES",
};

function heat(position) {
  const x = Math.min(Math.max(position, 0), 1) * (VIRIDIS.length - 1);
  const i = Math.min(Math.floor(x), VIRIDIS.length - 2);
  const part = (hex, j) => parseInt(hex.slice(2 * j, 2 * j + 2), 16);
  return `rgb(${[0, 1, 2].map(j => Math.round(part(VIRIDIS[i], j) * (i + 1 - x) + part(VIRIDIS[i + 1], j) * (x - i)))})`;
}

// The regions of one frame over the walls, in the plane of the axes `plane`; onpick is told which region is pointed at.
function drawMap(host, map, frame, { colouring, range, arrows, plane, axes = true, onpick = null }) {
  const width = Math.round(host.clientWidth) || 300, [u, v] = plane, d = map.axes.length;
  const boxes = frame.box.map(i => map.boxes[i]).map(box => [box[u], box[v], box[u + d], box[v + d]]);
  const [x0, y0, x1, y1] = [0, 1, 2, 3].map(i => (i < 2 ? Math.min : Math.max)(...boxes.map(box => box[i])));
  const [left, bottom, margin] = axes ? [44, 38, 6] : [2, 2, 2];
  const scale = Math.min((width - left - margin) / (x1 - x0), 460 / (y1 - y0));
  const height = scale * (y1 - y0) + bottom + margin;
  const at = x => left + scale * (x - x0), up = y => height - bottom - scale * (y - y0);
  const rectangle = ([a, b, c, e], attributes) =>
    svg("rect", { x: at(a), y: up(e), width: scale * (c - a), height: scale * (e - b), ...attributes });
  const id = `clip-${drawMap.count = (drawMap.count || 0) + 1}`;
  const inside = svg("g", { "clip-path": `url(#${id})` });
  const values = frame[colouring], [low, high] = range || [0, Math.max(...(values || [1]))];
  const shapes = boxes.map((box, i) => rectangle(box, {
    class: "region", "data-region": i, "fill-opacity": d > 2 ? 0.6 : 1,
    fill: values ? heat((values[i] - low) / (high - low || 1)) : "#8a94a0" }));
  inside.append(...shapes);
  if (u === 0 && v === 1) {
    inside.append(...map.walls.map(wall => rectangle(wall, { class: "wall" })),
      ...map.chasms.map(chasm => rectangle(chasm, { class: "chasm" })));
  }
  const centre = i => [at((boxes[i][0] + boxes[i][2]) / 2), up((boxes[i][1] + boxes[i][3]) / 2)];
  const pairs = arrows === "plan" ? (frame.target || []).map((to, from) => [from, to]) : frame[arrows] || [];
  const marks = svg("g", { class: arrows });
  for (const [from, to] of pairs) {
    if (from === to) continue;
    const [[ax, ay], [bx, by]] = [centre(from), centre(to)];
    const length = Math.hypot(bx - ax, by - ay) || 1, [nx, ny] = [(bx - ax) / length, (by - ay) / length];
    const bend = Math.min(0.15 * length, 18);  // there and back part
    const [cx, cy] = [(ax + bx) / 2 - ny * bend, (ay + by) / 2 + nx * bend];
    const [tx, ty] = [bx - nx * 3, by - ny * 3], turn = Math.atan2(ty - cy, tx - cx);
    const head = [turn + 2.65, turn - 2.65].map(side => `${tx + 8 * Math.cos(side)} ${ty + 8 * Math.sin(side)}`);
    const path = `M${ax} ${ay}Q${cx} ${cy} ${tx} ${ty}M${head[0]}L${tx} ${ty}L${head[1]}`;
    marks.append(svg("path", { class: "halo", d: path }), svg("path", { class: "edge", d: path }));
  }
  inside.append(marks);
  if (frame.goal) {
    const [x, y] = [at(frame.goal[u]), up(frame.goal[v])];
    const star = Array.from({ length: 10 }, (_, i) => {
      const radius = i % 2 ? 3.8 : 9, angle = (i * Math.PI) / 5 - Math.PI / 2;
      return `${x + radius * Math.cos(angle)},${y + radius * Math.sin(angle)}`;
    });
    inside.append(svg("polygon", { class: "goal", points: star.join(" ") }));
  }
  if (map.start && u === 0 && v === 1) {
    inside.append(svg("circle", { class: "goal", cx: at(map.start[0]), cy: up(map.start[1]), r: 5 }));
  }
  const picture = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `${plural(boxes.length, "region")} over the maze` },
    svg("defs", {}, svg("clipPath", { id }, rectangle([x0, y0, x1, y1]))), inside);
  if (axes) {
    for (const x of ticks(x0, x1, 6)) picture.append(svg("text", { x: at(x), y: height - bottom + 16, "text-anchor": "middle" }, compact(x)));
    for (const y of ticks(y0, y1, (scale * (y1 - y0)) / 45)) picture.append(svg("text", { x: left - 6, y: up(y) + 4, "text-anchor": "end" }, compact(y)));
    const name = i => map.axes[i] + (map.axes[i].length === 1 ? ", m" : ""), middle = up((y0 + y1) / 2);
    picture.append(svg("text", { x: at((x0 + x1) / 2), y: height - 4, "text-anchor": "middle" }, name(u)),
      svg("text", { x: 11, y: middle, "text-anchor": "middle", transform: `rotate(-90 11 ${middle})` }, name(v)));
  }
  if (onpick) {
    const pick = event => {
      const i = event.target.dataset?.region ?? [...shapes.keys()].find(j => {
        const box = shapes[j].getBoundingClientRect();
        return event.clientX >= box.left && event.clientX < box.right && event.clientY >= box.top && event.clientY < box.bottom;
      });
      shapes.forEach((shape, j) => shape.classList.toggle("picked", j === +i));
      if (i !== undefined) onpick(+i);
    };
    picture.addEventListener("pointermove", pick);
    picture.addEventListener("pointerdown", pick);
  }
  host.replaceChildren(picture);
}

function described(map, frame, i) {
  const d = map.axes.length, box = map.boxes[frame.box[i]];
  const where = map.axes.map((axis, j) => `${axis} ${compact(box[j])} to ${compact(box[j + d])}`).join(", ");
  const parts = [
    frame.chosen && `chosen ${compact(frame.chosen[i])} %`,
    frame.visited && `visited ${compact(frame.visited[i])} %`,
    frame.value && `value ${compact(frame.value[i])}`,
    frame.target && (frame.target[i] === i ? "plan: stay" : `plan: region ${frame.target[i]}`),
    frame.drawn && `practised ${compact(frame.drawn[i])} %`,
    frame.competence && `competence ${compact(frame.competence[i])}`,
  ];
  return `Region ${i}: ${where}; ${parts.filter(Boolean).join(", ")}.`;
}

function abstraction() {
  const mapped = runs.filter(run => run.map);
  if (!mapped.length) return;
  const framesOf = (run, place) => (run.map.frames[place] || run.map.frames[0]).moments;
  const every = mapped.flatMap(run => run.map.frames.flatMap(one => one.moments));
  const moments = [...new Set(every.map(frame => frame.env_steps))].sort((a, b) => a - b);
  const has = name => every.some(frame => (name === "none" ? true : frame[name === "plan" ? "target" : name]));
  const state = { now: moments.length - 1, place: 0, colouring: "chosen", arrows: "none", plane: [0, 1] };

  // a single run has room for its value map beside what was chosen
  const views = [() => state, ...(mapped.length === 1 && has("value") ? [() => ({ ...state, colouring: "value", arrows: "plan" })] : [])];
  const panels = mapped.flatMap(run => views.map(view => {
    const [host, caption, scale] = [html("div", { class: "map" }), html("figcaption"), html("div", { class: "legend" })];
    const title = mapped.length === 1 ? null : html("h3", {}, key(runs.indexOf(run)), run.name);
    return { run, view, host, caption, scale, node: html("figure", {}, title, scale, host, caption) };
  }));
  const slider = html("input", { type: "range", id: "moment", min: 0, max: moments.length - 1, value: state.now, "aria-label": "moment",
    oninput: () => { stop(); state.now = +slider.value; draw(); } });
  const output = html("output", { for: "moment" });
  let timer = null;
  const play = html("button", { type: "button", onclick: () => (timer ? stop() : start()) }, "Play");
  function stop() {
    clearInterval(timer);
    timer = null;
    play.textContent = "Play";
  }
  function start() {
    if (state.now === moments.length - 1) state.now = 0;
    play.textContent = "Pause";
    draw();
    timer = setInterval(() => {
      state.now++;
      draw();
      if (state.now >= moments.length - 1) stop();
    }, 500);
  }
  function latest(run) {
    const frames = framesOf(run, state.place);
    return frames.findLast(frame => frame.env_steps <= moments[state.now]) || frames[0];
  }
  function draw() {
    slider.value = state.now;
    output.textContent = `${compact(moments[state.now])} env steps`;
    slider.setAttribute("aria-valuetext", output.textContent);
    for (const view of views) {
      const { colouring, arrows } = view();
      const values = mapped.flatMap(run => numbers(latest(run)[colouring] || []));
      const shares = !["value", "competence"].includes(colouring);
      const range = values.length ? [Math.min(...values, ...(shares ? [0] : [])), Math.max(...values)] : [0, 1];
      panels.filter(panel => panel.view === view).forEach(panel => drawPanel(panel, latest(panel.run), { colouring, arrows, range }));
    }
  }
  function drawPanel({ run, host, caption, scale }, frame, { colouring, arrows, range }) {
    const edges = ["reaches", "misses"].includes(arrows) ? (frame[arrows] || []).filter(([from, to]) => from !== to) : null;
    const words = `${plural(frame.box.length, "region")} at ${compact(frame.env_steps)} env steps`
      + (edges ? `, ${plural(edges.length, "edge")}` : "") + (frame[colouring] ? "" : "; this run did not record the colours asked for");
    const plane = Math.max(...state.plane) < run.map.axes.length ? state.plane : [0, 1];
    caption.textContent = words;
    drawMap(host, run.map, frame, { colouring, arrows, range, plane, onpick: i => (caption.textContent = described(run.map, frame, i)) });
    host.onpointerleave = () => (caption.textContent = words);
    const bar = `background: linear-gradient(90deg, ${VIRIDIS.map(hex => `#${hex}`)})`;
    scale.replaceChildren(html("span", {}, COLOURINGS[colouring]),
      html("span", {}, `${compact(range[0])} `, html("i", { class: "bar", style: bar }), ` ${compact(range[1])}`));
  }
  const select = (label, options, onchange) => html("label", {}, `${label} `,
    html("select", { "aria-label": label, onchange: event => { onchange(event.target.value); draw(); } },
      ...options.map(([value, text]) => html("option", { value }, text))));
  const controls = html("div", { class: "controls" });
  controls.append(select("colour", Object.entries(COLOURINGS).filter(([name]) => has(name)), value => (state.colouring = value)));
  const known = Object.entries(ARROWS).filter(([name]) => has(name));
  if (known.length > 1) controls.append(select("arrows", known, value => (state.arrows = value)));
  const most = Math.max(...mapped.map(run => run.seeds.length));
  if (most > 1) {
    const labels = mapped.length === 1 ? mapped[0].seeds : Array.from({ length: most }, (_, i) => `${i + 1} of each`);
    controls.append(select("seed", labels.map((seed, i) => [i, seed]), value => { state.place = +value; stills(); }));
  }
  const axes = mapped.map(run => run.map.axes).sort((a, b) => b.length - a.length)[0];
  if (axes.length > 2) {
    const planes = [[0, 1], [0, 2], [1, 2]].map(pair => [pair.join(), pair.map(i => axes[i]).join("–")]);
    controls.append(select("plane", planes, value => (state.plane = value.split(",").map(Number))));
  }

  // the figure of the thesis: some moments side by side
  const longest = moments.at(-1);
  const wanted = longest >= 3e6 ? [1e6, 2e6, 3e6, longest] : [1, 2, 3, 4].map(i => (i * longest) / 4);
  const strips = html("div");
  function stills() {
    strips.replaceChildren(...mapped.map(run => {
      const frames = framesOf(run, state.place);
      const found = [...new Set(wanted.map(moment => frames.find(frame => frame.env_steps >= moment) || frames.at(-1)))];
      const figures = found.map(frame => {
        const host = html("div", { class: "map" });
        const show = () => { stop(); state.now = moments.indexOf(frame.env_steps); draw(); };
        requestAnimationFrame(() => drawMap(host, run.map, frame, { colouring: "chosen", arrows: "none", plane: [0, 1], axes: false }));
        return html("figure", { onclick: show }, host,
          html("figcaption", {}, `${plural(frame.box.length, "region")} at ${compact(frame.env_steps)}`));
      });
      return html("div", {}, mapped.length > 1 ? html("h3", {}, key(runs.indexOf(run)), run.name) : null,
        html("div", { class: "grid stills" }, ...figures));
    }));
  }
  const folded = html("details", { open: mapped.length === 1, ontoggle: () => folded.open && stills() },
    html("summary", {}, "Moments side by side"),
    html("p", { class: "note" }, "Coloured by how often each region was chosen, each moment on its own scale; press one to see it above."), strips);
  section("abstraction", "The abstraction as it grew",
    "Regions over the walls of the maze. Where only a part of a region can reach another one, it is split. "
      + `○ is the start${every.some(frame => frame.goal) ? ", ☆ the test goal" : ""}. Point at a region to read its values.`,
    controls, html("div", { class: "controls" }, html("div", { class: "moment" }, play, slider, output)),
    html("div", { class: "grid" }, ...panels.map(panel => panel.node)), folded);
  new ResizeObserver(draw).observe(panels[0].node);
  if (folded.open) stills();
}

function strategies() {
  const prefix = "sgim/share_";
  const chosen = runs.filter(run => Object.keys(run.epochs).some(name => name.startsWith(prefix)));
  if (!chosen.length) return;
  const names = [...new Set(chosen.flatMap(run => Object.keys(run.epochs).filter(name => name.startsWith(prefix))))]
    .map(name => name.slice(prefix.length));
  const panels = chosen.map(run => {
    const host = html("div");
    chart(host, () => {
      const { epochs } = run;
      let base = epochs.env_steps.map(() => 0);
      const series = names.filter(name => epochs[prefix + name]).map(name => {
        const y = epochs[prefix + name], low = base;
        base = low.map((value, i) => value + (y[i] ?? 0));
        return { name, slot: names.indexOf(name), x: epochs.env_steps, y, low, high: base, area: true };
      });
      return { series, x: unit, y: "share of episodes", low: 0, high: 1, height: 240 };
    });
    return html("figure", {}, html("h3", {}, key(runs.indexOf(run)), run.name), host);
  });
  section("strategies", "Strategies and teachers", "What SGIM chose for the training episodes, mean over seeds.",
    html("div", { class: "legend" }, ...names.map((name, i) =>
      html("span", {}, html("i", { class: "key box", style: `background: var(--c${i % SLOTS})` }), name))),
    html("div", { class: "grid" }, ...panels));
}

function small(title, name, pick, y, { clock = "env_steps", low } = {}) {
  const host = html("div");
  chart(host, () => ({
    series: runs.map((run, slot) => {
      const found = pick(run);
      return { name: run.name, slot, x: found ? clocked(found.table, clock) : [], y: found ? found.y : [] };
    }),
    x: clockLabel(clock), y, low, height: 170, bare: true,
  }));
  return html("figure", {}, html("h3", { title: name }, title), host);
}
const epochs = name => run => (run.epochs[name] ? { table: run.epochs, y: run.epochs[name] } : null);

function throughput() {
  const through = run => ({ table: run.epochs, y: run.epochs.env_steps });
  section("throughput", "Throughput", "Of all seeds of a run together, learning included; the first epoch also compiles.", legend(),
    html("div", { class: "grid" },
      small(`${unit}/s`, "env_steps_per_s", epochs("env_steps_per_s"), `${unit} per second`, { low: 0 }),
      small(`${unit} per seed over wall-clock`, "env_steps", through, unit, { clock: "wall_s", low: 0 })));
}

const LEVELS = [
  ["Controller", /^controller\//], ["Tutor", /^tutor\//], ["Commander", /^commander\//],
  ["Abstraction and refinement", /^(abstraction|refinement)\//], ["Forward model", /^forward_model\//],
  ["Adjacency", /^adjacency\//], ["SGIM", /^sgim\//], ["Practice", /^(saht|chime)\//], ["Test episodes", /^eval\//],
  ["Training episodes", /^train\//], ["Simulator", /^env\//],
];

function levels() {
  const tested = name => run => {
    const found = run.evaluations[name];
    return found ? { table: run.evaluations, y: found.mean } : null;
  };
  const all = [...new Set(runs.flatMap(run => [...Object.keys(run.epochs), ...Object.keys(run.evaluations)]))].filter(name => name.includes("/"));
  const folds = LEVELS.map(([title, pattern]) => [title, all.filter(name => pattern.test(name)).sort()]).filter(([, found]) => found.length);
  section("levels", "Losses and other metrics", "Means over seeds, one group for each level.", legend(), ...folds.map(([title, found]) => {
    const fold = html("details", { ontoggle: () => {
      if (!fold.open || fold.lastChild.tagName === "DIV") return;
      fold.append(html("div", { class: "grid small" }, ...found.map(name =>
        small(name.split("/")[1].replaceAll("_", " "), name, name.startsWith("eval/") ? tested(name) : epochs(name), name))));
    } }, html("summary", {}, `${title} (${found.length})`));
    return fold;
  }));
}

function configurations() {
  const alone = runs.length === 1;
  const head = ["setting", ...runs.map(run => run.name), ...(alone ? ["default"] : [])];
  const rows = settings.map(row => [html("code", {}, row.key), ...row.values.map(value => html("code", {}, value))]);
  section("settings", alone ? "Settings that differ from the defaults" : "Settings in which the runs differ", null,
    rows.length ? table(head, rows, { class: "words" }) : html("p", { class: "note" }, "None."),
    ...runs.map(run => html("details", {}, html("summary", {}, `All settings of ${run.name}`),
      html("a", { download: "config.yaml", href: `data:text/yaml;charset=utf-8,${encodeURIComponent(run.config)}` }, "save as config.yaml"),
      html("pre", {}, run.config))));
}

function pictures() {
  const names = [...new Set(runs.flatMap(run => run.pictures.map(one => one.name)))];
  if (!names.length) return;
  section("figures", "Figures", "As each run has drawn them.", ...names.map(name =>
    html("div", { class: "grid films" }, ...runs.flatMap((run, slot) => run.pictures.filter(one => one.name === name).map(one =>
      html("figure", { class: "film" }, html("h3", {}, key(slot), `${run.name}: ${name}`),
        html("img", { alt: `${name} of ${run.name}`, src: `data:image/png;base64,${one.data}` })))))));
}

function films() {
  section("films", "Films", null, html("div", { class: "grid films" }, ...runs.map((run, slot) => {
    const { kind, data, name, command, large } = run.film;
    const figure = html("figure", { class: "film" }, html("h3", {}, key(slot), run.name));
    if (kind === "html") { // the player of `star render`, in a frame that can do nothing but play
      const size = data.match(/<img id="picture" width="(\d+)" height="(\d+)"/);
      const shape = size ? `aspect-ratio: ${size[1]} / ${+size[2] + 46}` : "height: 26rem";
      figure.append(html("iframe", { sandbox: "allow-scripts", srcdoc: data, title: `${name} of ${run.name}`, style: shape }));
    } else if (kind === "mp4") {
      figure.append(html("video", { controls: true, loop: true, muted: true, src: `data:video/mp4;base64,${data}` }));
    } else if (kind === "gif") {
      figure.append(html("img", { alt: `${name} of ${run.name}`, src: `data:image/gif;base64,${data}` }));
    } else {
      const why = large.length ? `${large.join(", ")}: too large for this page. To make a smaller one: ` : "None yet. To make one: ";
      figure.append(html("p", { class: "note" }, why, html("code", {}, command)));
    }
    return figure;
  })));
}

function changed({ facts }) {
  const all = facts.changes.map(({ key, value, env_steps }) =>
    `${key} ${value} from ${env_steps.toLocaleString("en")} ${unit}`).join("; ");
  return all || (facts.starts.at(-1)?.settings ? "nothing" : "");
}

function provenance() {
  const facts = [
    ["run", run => html("code", {}, run.facts.path)],
    ["seeds", run => run.seeds.join(", ")],
    [`${unit} per seed`, run => `${run.facts.env_steps.toLocaleString("en")} of ${run.facts.total_env_steps.toLocaleString("en")}`],
    ["wall-clock", run => duration(run.facts.wall_s)],
    ...(runs.some(run => run.facts.engine) ? [["engine", run => run.facts.engine]] : []),
    ["began", run => run.facts.starts.map(({ time, env_steps }) =>
      `${time.slice(0, 16).replace("T", " ")} UTC${env_steps ? `, from ${compact(env_steps)} ${unit}` : ""}`).join("; ")],
    ["device", run => [...new Set(run.facts.starts.map(start => start.device))].join("; ")],
    ["commit", run => [...new Set(run.facts.starts.map(start => start.commit).filter(Boolean))].join("; ")],
    ["Python", run => [...new Set(run.facts.starts.map(start => start.python))].join("; ")],
    ["packages", run => [...new Set(run.facts.starts.map(({ versions }) =>
      Object.entries(versions).map(([name, version]) => `${name} ${version}`).join(", ")))].join("; ")],
    ...(runs.some(run => run.facts.changes.length) ? [["changed on resume", changed]] : []),
    ...(runs.some(run => run.facts.notices.length) ? [["notes", run => run.facts.notices.join("; ") || "none"]] : []),
    ["the same again", run => html("code", {}, run.facts.command)],
  ];
  const rows = facts.map(([name, cell]) => [name, ...runs.map(run => cell(run) || "not recorded")]);
  section("provenance", "Provenance", null, table(["", ...runs.map(run => run.name)], rows, { class: "words" }));
  page.append(html("footer", {}, `Made by star report, star-rl ${made.version}, ${made.date}.`));
}

for (const draw of [opening, evaluations, abstraction, strategies, pictures, throughput, levels, films, configurations, provenance]) draw();
if (watched) watch();

// The page of `star watch` loads itself again when the run has written more, with what was chosen on it.
function watch() {
  const controls = () => [...document.querySelectorAll("input, select, details")].map(node => [
    [node.tagName, node.id, node.ariaLabel, node.name, node.type === "radio" && node.value, node.firstChild?.textContent].join(), node]);
  const chosen = node => {
    if (node.tagName === "DETAILS") return node.open;
    if (node.type === "range") return node.value === node.max ? "latest" : node.value;
    return ["radio", "checkbox"].includes(node.type) ? node.checked : node.value;
  };
  const choose = (node, value) => {
    if (node.tagName === "DETAILS") node.open = value;
    else if (["radio", "checkbox"].includes(node.type)) value && node.click();
    else {
      node.value = value;
      node.dispatchEvent(new Event(node.type === "range" ? "input" : "change"));
    }
  };
  const before = JSON.parse(sessionStorage.getItem("chosen") || "{}");
  for (const [name, node] of controls()) {
    if (name in before && before[name] !== chosen(node)) choose(node, before[name]);
  }
  history.scrollRestoration = "manual";
  document.documentElement.style.overflowAnchor = "none";
  let place = sessionStorage.getItem("scroll");  // null once the page stands there
  const settle = (tries = 10) => {  // charts have their height only after a while
    scrollTo(0, place);
    if (Math.abs(scrollY - place) > 1 && tries) setTimeout(settle, 100, tries - 1);
    else place = null;
  };
  if (place !== null) setTimeout(settle, 100);
  const changes = new EventSource(`changes?of=${watched}`);
  changes.onmessage = () => {
    changes.close();
    sessionStorage.setItem("chosen", JSON.stringify(Object.fromEntries(controls().map(([name, node]) => [name, chosen(node)]))));
    sessionStorage.setItem("scroll", place ?? scrollY);
    location.reload();
  };
  changes.onerror = () => {
    changes.close();
    document.getElementById("live").textContent = "no longer renewed";
  };
}
