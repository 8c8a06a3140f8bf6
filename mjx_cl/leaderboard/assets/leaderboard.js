"use strict";
(() => {
  // Names come from plug-ins and files: they enter the page as text nodes and attributes only, never as markup.

  const data = JSON.parse(document.getElementById("data").textContent);
  const SVG = document.querySelector("svg").namespaceURI;  // not spelled out, so that the file names no address at all
  const DASH = "\u2013";
  const FEW = "\u2020", NOTED = "*";
  const FIRST_ROWS = 100;  // a long table is drawn in full on request only
  const BEST = 7;          // curves shown at first: as many as there are colours
  const SHAPES = 4;
  const DASHES = ["", "7 3", "2 2", "9 3 2 3"];
  const NEAR_S = [-5, 20]; // what `around the onset` shows

  const byId = id => document.getElementById(id);
  const isNull = value => value === null || value === undefined;
  const entries = object => new Map(Object.entries(object || {}));

  /** Numbers: 2^exponent times the IEEE 754 half floats, little-endian, of a base64 text; null for what is not finite. */
  function halves([exponent, text]) {
    const view = new DataView(Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer);
    return Array.from({length: view.byteLength / 2}, (_, k) => {
      const bits = view.getUint16(2 * k, true), power = bits >> 10 & 31, rest = bits & 1023;
      const size = 2 ** exponent * (power ? 2 ** (power - 25) * (1024 + rest) : 2 ** -24 * rest);
      return power === 31 ? null : bits >> 15 ? -size : size;
    });
  }

  // ---- data ------------------------------------------------------------------------------------------------------------------------

  const references = new Set(data.references);
  const rows = data.rows.map(values => Object.fromEntries(values.map((value, i) => [data.keys[i], value])));
  const fewOf = new Set(rows.filter(row => row.arl0_few).map(row => row.detector));
  const overall = data.overall.map(entry => ({...entry, few: fewOf.has(entry.detector)}));
  const curves = new Map([...entries(data.curves)].map(([name, robots]) => [name, entries(robots)]));
  const RANK = {key: "rank", label: "Rank", kind: "integer", better: -1, help: "By the cost score of the chosen profile; references are not ranked"};
  const columns = {
    rows: data.columns.filter(c => c.tables.includes("rows")),
    overall: [RANK, ...data.columns.filter(c => c.tables.includes("overall"))],
  };
  const costKeys = Object.keys(data.profiles).map(profile => `cost_${profile}`);
  const choices = Object.fromEntries(["robot", "fault", "severity"].map(key => [key, distinct(rows.map(row => row[key]))]));

  // colour, marker and dash of a detector stay the same whatever is filtered: they follow its place by the standard score
  const names = [...new Set([...sorted(overall, "-cost_standard"), ...rows].map(entry => entry.detector).concat([...curves.keys()]))];
  const ranked = names.filter(name => !references.has(name));
  const looks = new Map(names.map((name, i) => {
    const at = references.has(name) ? -1 : ranked.indexOf(name);
    const turn = at < 0 ? i : Math.floor(at / BEST);
    const color = at < 0 ? "var(--reference)" : `var(--c${at % BEST})`;
    return [name, {color, shape: turn % SHAPES, dash: at < 0 ? "2 3" : DASHES[turn % SHAPES]}];
  }));
  const firstShown = new Set([...ranked.slice(0, BEST), ...names.filter(name => references.has(name))]);
  const look = name => looks.get(name) || {color: "var(--reference)", shape: 0, dash: ""};

  function distinct(values) {
    return [...new Set(values)].sort(compare).map(String);
  }

  function compare(x, y) {
    return typeof x === "number" && typeof y === "number" ? x - y : String(x).localeCompare(String(y), "en", {numeric: true});
  }

  /** Rows in the order of `key` or `-key`; undefined values stand last both ways, ties keep their order. */
  function sorted(list, order) {
    const down = order.startsWith("-"), key = down ? order.slice(1) : order;
    return [...list].sort((a, b) => {
      const x = a[key], y = b[key];
      if (isNull(x) || isNull(y)) return isNull(x) - isNull(y);
      return down ? compare(y, x) : compare(x, y);
    });
  }

  // ---- text ------------------------------------------------------------------------------------------------------------------------

  function figure(value, kind) {
    if (isNull(value)) return DASH;
    if (typeof value !== "number") return String(value);
    if (kind === "score") return value.toFixed(1);
    if (kind === "ratio") return value.toFixed(3);
    if (kind === "share") {
      const percent = 100 * value;
      return percent.toFixed(Math.abs(percent) % 1 < 0.05 || (Math.abs(percent) >= 10 && percent <= 90) ? 0 : 1);
    }
    if (kind === "integer" || Math.abs(value) >= 1000) return Math.round(value).toLocaleString("en-US");
    if (value === 0 || Math.abs(value) >= 0.001) return String(Number(value.toPrecision(3)));
    return value.toExponential(1);
  }

  function withUnit(value, kind) {
    return figure(value, kind) + (kind === "share" && !isNull(value) ? " %" : "");
  }

  function interval(ci, kind) {
    if (isNull(ci) || (isNull(ci[0]) && isNull(ci[1]))) return "";
    if (isNull(ci[1])) return `\u2265 ${figure(ci[0], kind)}`;
    if (isNull(ci[0])) return `\u2264 ${figure(ci[1], kind)}`;
    return `[${figure(ci[0], kind)}, ${figure(ci[1], kind)}]`;
  }

  const seconds = value => `${value < 0 ? "" : "+"}${figure(value, "number")} s`;
  const shorten = (text, length) => text.length > length ? `${text.slice(0, length - 1)}\u2026` : text;

  // ---- elements --------------------------------------------------------------------------------------------------------------------

  function fill(node, attributes, children) {
    for (const [name, value] of Object.entries(attributes || {})) {
      if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
      else if (value === true) node.setAttribute(name, "");
      else if (!isNull(value) && value !== false) node.setAttribute(name, value);
    }
    node.append(...children.flat(Infinity).filter(child => !isNull(child) && child !== ""));
    return node;
  }
  const el = (tag, attributes, ...children) => fill(document.createElement(tag), attributes, children);
  const draw = (tag, attributes, ...children) => fill(document.createElementNS(SVG, tag), attributes, children);

  const tips = new WeakMap();

  /** Gives a mark its tooltip, which a screen reader reads too. */
  function tip(node, lines, focusable = false) {
    tips.set(node, lines);
    node.classList.add("tipped");
    node.setAttribute("role", "img");
    node.setAttribute("aria-label", lines.join(", "));
    if (focusable) node.setAttribute("tabindex", "0");
    return node;
  }

  function showTip(event) {
    const node = event.target.closest && event.target.closest(".tipped"), box = byId("tip");
    box.hidden = !node || !tips.has(node);
    if (box.hidden) return;
    box.replaceChildren(...tips.get(node).map((line, i) => el(i ? "div" : "strong", null, line)));
    const at = node.getBoundingClientRect();
    const x = event.clientX === undefined ? at.right : event.clientX, y = event.clientY === undefined ? at.top : event.clientY;
    box.style.left = `${Math.max(4, Math.min(x + 14, document.documentElement.clientWidth - box.offsetWidth - 8))}px`;
    box.style.top = `${y + 18 + box.offsetHeight > window.innerHeight ? y - box.offsetHeight - 10 : y + 18}px`;
  }
  for (const kind of ["pointermove", "pointerdown", "focusin"]) document.addEventListener(kind, showTip);
  for (const kind of ["focusout", "scroll", "pointerleave"]) document.addEventListener(kind, () => { byId("tip").hidden = true; }, true);

  // ---- state: the hash holds all of it -----------------------------------------------------------------------------------------------

  const FIRST = {profile: "standard", robot: "", fault: "", severity: "", q: "", refs: "", cols: "", sort: "", top: "", span: "", seed: ""};
  let state = {...FIRST, show: null};  // show: names with a curve, null: firstShown
  let route = null;                    // [robot, fault, severity] of a fault page, null: the board
  let allRows = false;

  function parse(text) {
    const at = text.indexOf("?"), page = text.startsWith("fault/");
    const query = new URLSearchParams(page ? (at < 0 ? "" : text.slice(at + 1)) : text);
    const next = {...FIRST, show: query.has("show") ? new Set(query.getAll("show").filter(name => looks.has(name))) : null};
    for (const key of Object.keys(FIRST)) if (query.has(key)) next[key] = query.get(key);
    for (const key of Object.keys(choices)) if (!choices[key].includes(next[key])) next[key] = "";
    if (!Object.hasOwn(data.profiles, next.profile)) next.profile = FIRST.profile;
    for (const [key, table] of [["sort", "rows"], ["top", "overall"]]) {
      if (!columns[table].some(c => c.key === next[key].replace(/^-/, ""))) next[key] = "";
    }
    state = next;
    route = null;
    if (page) {
      try {
        route = text.slice(6, at < 0 ? undefined : at).split("/").map(decodeURIComponent);
      } catch {
        route = ["", "", ""];  // broken escapes name no fault
      }
    }
  }

  function query() {
    const out = new URLSearchParams();
    for (const key of Object.keys(FIRST)) if (state[key] !== FIRST[key]) out.set(key, state[key]);
    if (state.show) for (const name of state.show.size ? state.show : [""]) out.append("show", name);
    return out.toString();
  }

  function pathOf(key) {
    const tail = query();
    return `#fault/${key.map(part => encodeURIComponent(String(part))).join("/")}${tail ? `?${tail}` : ""}`;
  }

  function change(part) {
    Object.assign(state, part);
    history.replaceState(null, "", route ? pathOf(route) : `#${query()}`);
    render();
  }

  // ---- tables ----------------------------------------------------------------------------------------------------------------------

  /** A table whose header sorts. `order` is key, -key or empty; `which` is the state that holds it. */
  function table(which, shown, list, order) {
    const head = shown.map(column => {
      const now = order.replace(/^-/, "") === column.key ? (order.startsWith("-") ? "descending" : "ascending") : "none";
      const first = column.better > 0 ? `-${column.key}` : column.key;
      const next = order !== first ? first : first.startsWith("-") ? column.key : `-${column.key}`;
      const arrow = el("span", {class: "arrow", "aria-hidden": "true"}, {none: "", ascending: "\u25B2", descending: "\u25BC"}[now]);
      const press = {type: "button", title: column.help, "data-focus": `${which}:${column.key}`, onclick: () => change({[which]: next})};
      const kind = `${column.kind}${column.key === "detector" ? " pin" : ""}`;
      return el("th", {scope: "col", "aria-sort": now, class: kind, "data-key": column.key}, el("button", press, column.label, arrow));
    });
    const body = list.map(row => el("tr", {class: references.has(row.detector) ? "reference" : null}, shown.map(column => cell(column, row))));
    return el("table", null, el("thead", null, el("tr", null, head)), el("tbody", null, body));
  }

  function cell(column, row) {
    const value = row[column.key], ci = interval(row[`${column.key}_ci`], column.kind);
    const pin = column.key === "detector";
    const text = withUnit(value, column.kind);
    const linked = column.key === "fault" && pages.has(keyOf(row));
    const kind = `${column.kind}${pin ? " pin" : ""}${costKeys.includes(column.key) ? " cost" : ""}`;
    return el(pin ? "th" : "td", {class: kind, scope: pin ? "row" : null, "data-key": column.key},
      pin ? swatch(row.detector, 14) : null,
      el("span", {class: "v"}, linked ? el("a", {href: pathOf([row.robot, row.fault, row.severity])}, text) : text),
      column.few && row[column.few] ? el("sup", {class: "mark", title: "rests on fewer than 50 alarms"}, FEW) : null,
      isNoted(column, row) ? el("sup", {class: "mark", title: row.note}, NOTED) : null,
      ci ? el("span", {class: "ci"}, ci) : null);
  }

  /** Whether the row's note is about this figure. */
  const isNoted = (column, row) => !isNull(column.noted) && row[column.key] > column.noted && Boolean(row.note);

  const FOOTNOTE = `${FEW} rests on fewer than 50 alarms of healthy robots: an order of magnitude rather than a figure. `;

  function footnotes(list) {
    const noted = columns.rows.find(column => list.some(row => isNoted(column, row)));
    return el("p", {class: "foot"}, list.some(row => row.few || row.arl0_few) ? el("span", {class: "few"}, FOOTNOTE) : null,
      noted ? el("span", {class: "noted"}, `${NOTED} ${noted.label.toLowerCase()} above ${noted.noted}: the row's note, shown by pointing at the mark, tells why. `) : null,
      `Small figures are 95 % intervals. ${DASH}: undefined. Grey rows are references that look at nothing, or at the truth, and are not ranked.`);
  }

  function ranks() {
    const key = `cost_${state.profile}`;
    const order = sorted(overall.filter(entry => !references.has(entry.detector) && !isNull(entry[key])), `-${key}`);
    return overall.map(entry => ({...entry, rank: order.indexOf(entry) < 0 ? null : order.indexOf(entry) + 1}));
  }

  function visible() {
    const words = state.q.toLowerCase().split(/\s+/).filter(Boolean);
    const text = row => [row.detector, row.robot, row.fault, row.note].filter(part => !isNull(part)).join("\n").toLowerCase();
    return rows.filter(row => isKept(row.detector)
      && Object.keys(choices).every(key => !state[key] || String(row[key]) === state[key])
      && words.every(word => text(row).includes(word)));
  }

  /** Columns of the full table: of the three scores, the chosen profile's alone until all columns are shown. */
  const chosen = column => state.cols === "all" || (column.core && (!costKeys.includes(column.key) || column.key === `cost_${state.profile}`));

  function showTables() {
    const cost = `-cost_${state.profile}`;
    const top = sorted(ranks(), state.top || cost).filter(entry => isKept(entry.detector));
    byId("overall").replaceChildren(table("top", columns.overall, top, state.top || cost));
    byId("overall-foot").replaceChildren(footnotes(top));
    const list = visible();
    // without a chosen order: fault by fault, the best first
    const order = state.sort ? sorted(list, state.sort) : sorted(sorted(sorted(sorted(list, cost), "severity"), "fault"), "robot");
    const cut = allRows ? order : order.slice(0, FIRST_ROWS);
    byId("full").replaceChildren(table("sort", columns.rows.filter(chosen), cut, state.sort));
    byId("count").textContent = `${list.length.toLocaleString("en-US")} of ${rows.length.toLocaleString("en-US")} rows`;
    byId("more").hidden = cut.length === order.length;
    byId("more").textContent = `Show all ${order.length.toLocaleString("en-US")} rows`;
    byId("full-foot").replaceChildren(footnotes(cut));
  }

  // ---- drawing ---------------------------------------------------------------------------------------------------------------------

  const scale = (low, high, from, to) => value => from + (value - low) / (high - low || 1) * (to - from);

  function ticks(low, high, count) {
    const rough = (high - low) / count || 1, power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map(k => k * power).find(s => s >= rough * 0.999), out = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + step * 1e-9; k++) out.push(Number((k * step).toPrecision(12)));
    return out;
  }

  function outline(shape, x, y, r) {
    if (shape === 1) return `M${x - r} ${y - r}h${2 * r}v${2 * r}h${-2 * r}z`;
    if (shape === 2) return `M${x} ${y - 1.2 * r}l${1.2 * r} ${2.1 * r}h${-2.4 * r}z`;
    if (shape === 3) return `M${x} ${y - 1.35 * r}l${1.35 * r} ${1.35 * r}l${-1.35 * r} ${1.35 * r}l${-1.35 * r} ${-1.35 * r}z`;
    return `M${x - r} ${y}a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0z`;
  }

  function marker(name, x, y, r, hollow = false) {
    const {color, shape} = look(name);
    return draw("path", {d: outline(shape, x, y, r), style: `fill:${hollow ? "var(--card)" : color};stroke:${color};stroke-width:1.4`});
  }

  function swatch(name, width) {
    const {color, dash} = look(name);
    return draw("svg", {class: "swatch", width, height: 12, "aria-hidden": "true"},
      width > 20 ? draw("line", {x1: 0, x2: width, y1: 6, y2: 6, style: `stroke:${color};stroke-dasharray:${dash};stroke-width:2`}) : null,
      marker(name, width / 2, 6, 3.6));
  }

  const line = (x1, y1, x2, y2, kind) => draw("line", {x1, y1, x2, y2, class: kind});
  const label = (x, y, text, kind, anchor) => draw("text", {x, y, class: kind, "text-anchor": anchor}, text);
  const gridX = (svg, values, x, top, bottom) => values.forEach(t => svg.append(
    line(x(t), top, x(t), bottom, "grid"), label(x(t), bottom + 15, figure(t, "number"), "tick", "middle")));
  const gridY = (svg, values, y, left, right) => values.forEach(t => svg.append(
    line(left, y(t), right, y(t), "grid"), label(left - 6, y(t) + 4, figure(t, "number"), "tick", "end")));
  const isKept = name => state.refs !== "no" || !references.has(name);
  const isOn = name => (state.show || firstShown).has(name) && isKept(name);

  function showLegend() {
    const toggle = name => {
      const next = new Set(state.show || firstShown);
      if (!next.delete(name)) next.add(name);
      change({show: next});
    };
    const focus = name => {  // pointing at a name brings its marks forward
      for (const svg of document.querySelectorAll("#curves svg, #intervals svg")) {
        svg.classList.toggle("focused", name !== null);
        for (const g of svg.querySelectorAll("g.series")) g.classList.toggle("hot", g.dataset.name === name);
      }
    };
    const key = name => el("button", {type: "button", class: "key", "aria-pressed": String(isOn(name)), "data-focus": `legend:${name}`,
      onclick: () => toggle(name), onpointerenter: () => focus(name), onpointerleave: () => focus(null)}, swatch(name, 26), name);
    const many = [[`Best ${BEST}`, null], ["All", new Set(names)], ["None", new Set()]].map(([text, show]) => el("button",
      {type: "button", class: "plain", "data-focus": `legends:${text}`, onclick: () => change({show})}, text));
    byId("legend").replaceChildren(...names.filter(isKept).map(key), ...many);
  }

  /** Latency against false alarms per hour, one panel per robot on common axes. */
  function showCurves() {
    const host = byId("curves"), all = [...curves.values()];
    const robots = distinct(all.flatMap(c => [...c.keys()])).filter(robot => !state.robot || robot === state.robot);
    const known = p => !isNull(p.latency_mean_s) && !isNull(p.false_alarms_per_hour);
    const points = all.flatMap(c => [...c.values()].flat()).filter(known);
    if (!points.length || !robots.length) return host.replaceChildren(el("p", {class: "empty"}, "No curves were recorded."));
    const positive = points.map(p => p.false_alarms_per_hour).filter(v => v > 0);
    const low = Math.floor(Math.log10(Math.min(1, ...positive))), high = Math.max(low + 1, Math.ceil(Math.log10(Math.max(1, ...positive))));
    const zero = positive.length < points.length;
    const yMax = Math.max(...points.map(p => p.latency_mean_s)) * 1.04 || 1;
    const space = host.clientWidth, across = Math.max(1, Math.min(robots.length, 3, Math.floor(space / 300)));
    const w = Math.floor((space - 16 * (across - 1)) / across), h = Math.min(300, Math.max(230, 0.8 * w));
    const left = 40, right = w - 16, top = 24, bottom = h - 38, start = left + (zero ? 26 : 6);
    const x = v => v > 0 ? scale(low, high, start, right)(Math.log10(v)) : left + 8, y = scale(0, yMax, bottom, top);
    host.replaceChildren(...robots.map(robot => {
      const svg = draw("svg", {width: w, height: h, role: "group", "aria-label": `mean latency against false alarms per hour, ${robot}`});
      svg.append(label(left, 14, robot, "title"));
      gridY(svg, ticks(0, yMax, 5), y, left, right);
      const stride = Math.ceil((high - low) / Math.max(2, Math.floor((right - start) / 42)));
      for (let d = low; d <= high; d += stride) {
        const at = x(10 ** d), text = d < -2 || d > 3 ? `1e${d}` : String(10 ** d);
        svg.append(line(at, top, at, bottom, "grid"), label(at, bottom + 16, text, "tick", "middle"));
      }
      if (zero) svg.append(label(x(0), bottom + 16, "0", "tick", "middle"), line(start - 8, bottom - 4, start - 12, bottom + 4, "axis"));
      svg.append(line(left, bottom, right, bottom, "axis"), label((left + right) / 2, h - 6, "false alarms per hour", "tick", "middle"));
      svg.append(label(right, 14, "mean latency [s]", "tick", "end"));
      for (const name of [...names].reverse()) {
        if (!isOn(name) || !curves.has(name) || !curves.get(name).has(robot)) continue;
        const track = sorted(curves.get(name).get(robot).filter(known), "false_alarms_per_hour");
        const g = draw("g", {class: "series", "data-name": name}), {color, dash} = look(name);
        const path = track.map((p, i) => `${i ? "L" : "M"}${x(p.false_alarms_per_hour).toFixed(1)} ${y(p.latency_mean_s).toFixed(1)}`).join("");
        g.append(draw("path", {d: path, class: "curve", style: `stroke:${color};stroke-dasharray:${dash}`}));
        g.append(tip(draw("path", {d: path, class: "hit"}), [name, robot]));
        for (const p of track) {
          const dot = marker(name, x(p.false_alarms_per_hour), y(p.latency_mean_s), 3, isNull(p.detected) || p.detected < 0.5);
          g.append(tip(dot, [name, robot, `${figure(p.false_alarms_per_hour, "number")} false alarms per hour`,
            `mean latency ${figure(p.latency_mean_s, "number")} s`, `detected ${withUnit(p.detected, "share")}`]));
        }
        svg.append(g);
      }
      return svg;
    }));
  }

  /** Cost scores with their intervals, and mean ranks with the critical difference. */
  function showIntervals() {
    const host = byId("intervals"), key = `cost_${state.profile}`, space = host.clientWidth;
    const list = sorted(overall, `-${key}`).filter(entry => isKept(entry.detector));
    if (!list.length) return host.replaceChildren(el("p", {class: "empty"}, "No detector was scored."));
    const wide = space >= 720, w = wide ? Math.floor((space - 16) / 2) : space;
    const real = list.filter(entry => !references.has(entry.detector));
    const scores = real.flatMap(entry => [entry[key], ...(entry[`${key}_ci`] || [])]).filter(v => !isNull(v));
    const low = Math.max(-100, Math.min(0, ...scores)), high = Math.min(200, Math.max(100, ...scores));  // a reference may lie far below
    const best = Math.min(...real.map(entry => entry.mean_rank).filter(v => !isNull(v))), cd = data.meta.critical_difference;
    const last = Math.max(2, ...list.map(entry => entry.mean_rank).filter(v => !isNull(v)));
    const band = isNull(cd) || !Number.isFinite(best) ? null : {from: best, to: best + cd, text: `critical difference ${figure(cd, "number")}`};
    const cost = {key, kind: "score", low, high, title: `cost score, ${data.profiles[state.profile]} (higher is better)`};
    const rank = {key: "mean_rank", kind: "number", low: 1, high: Math.max(last, band ? band.to : 0), band};
    host.replaceChildren(dots(list, cost, w), dots(list, {...rank, title: "mean rank, standard score (lower is better)"}, w));
  }

  function dots(list, {key, kind, low, high, title, band}, w) {
    const row = 21, left = Math.min(150, 0.36 * w), right = w - 12, top = 42, bottom = top + row * list.length, h = bottom + 22;
    const x = scale(low, high, left + 8, right), letters = Math.floor((left - 4) / 6.6);
    const svg = draw("svg", {width: w, height: h, role: "group", "aria-label": title}, label(w < 500 ? 0 : left, 14, title, "title"));
    if (band) {
      const end = Math.min(right, x(band.to));
      svg.append(tip(draw("rect", {x: x(band.from), y: top - 4, width: Math.max(1, end - x(band.from)), height: bottom - top + 4, class: "band"}),
        [band.text, "ranks inside it cannot be told from the best"]));
      svg.append(draw("path", {d: `M${x(band.from)} ${top - 4}v-5H${end}v5`, class: "bracket"}));
      svg.append(label(x(band.from) + 2, top - 13, band.text, "tick"));
    }
    gridX(svg, ticks(low, high, Math.max(3, Math.floor((right - left) / 60))), x, top, bottom);
    list.forEach((entry, i) => {
      const name = entry.detector, at = top + row * (i + 0.5), value = entry[key], ci = entry[`${key}_ci`];
      const g = draw("g", {class: `series${isOn(name) ? "" : " off"}${references.has(name) ? " reference" : ""}`, "data-name": name});
      g.append(label(left, at + 4, shorten(name, letters), "name", "end"));
      if (isNull(value)) {
        g.append(label(left + 12, at + 4, DASH, "tick"));
      } else {
        const inside = v => Math.min(high, Math.max(low, v)), outside = value < low || value > high;
        if (ci && !outside && !isNull(ci[0]) && !isNull(ci[1])) {
          g.append(fill(line(x(inside(ci[0])), at, x(inside(ci[1])), at, "whisker"), {style: `stroke:${look(name).color}`}, []));
        }
        g.append(outside ? label(x(inside(value)), at + 4, value < low ? "\u25C4" : "\u25BA", "far", "middle") : marker(name, x(value), at, 4));
      }
      g.append(draw("rect", {x: 0, y: at - row / 2, width: w, height: row, class: "hit"}));
      svg.append(tip(g, [name, `${title.split(" (")[0]}: ${figure(value, kind)}`, ...(ci ? [`95 % interval ${interval(ci, kind)}`] : [])], true));
    });
    return svg;
  }

  // ---- fault pages -------------------------------------------------------------------------------------------------------------------

  const keyOf = row => JSON.stringify([row.robot, row.fault, row.severity].map(String));
  const pages = new Map(data.faults.map(fault => [keyOf(fault), fault]));

  /** The fault that a hash names; a severity may be written in another way, such as 1.0 for 1. */
  function pageOf([robot, fault, severity]) {
    const fits = given => String(given) === severity || (severity !== "" && Number(severity) === given);
    return data.faults.find(f => f.robot === robot && f.fault === fault && fits(f.severity));
  }

  function showFault() {
    const host = byId("page"), found = pageOf(route), back = el("a", {class: "back", href: `#${query()}`}, "\u2190 leaderboard");
    if (!found) {
      return host.replaceChildren(el("nav", null, back), el("h2", null, "No such fault"),
        el("p", {class: "empty"}, `No streams of ${route.join(" / ")} were recorded.`));
    }
    const lives = [found, ...(found.others || [])], life = lives.find(one => String(one.seed) === state.seed) || found;
    const fault = {...found, ...life}, others = lives.filter(one => one !== life);
    const at = data.faults.indexOf(found), title = `${fault.robot}: ${fault.fault}, severity ${figure(fault.severity, "number")}`;
    const neighbour = (other, text) => other ? el("a", {href: pathOf([other.robot, other.fault, other.severity])}, text) : null;
    const alarms = [...entries(fault.alarms)].filter(([name]) => isKept(name));
    const own = rows.filter(row => keyOf(row) === keyOf(fault) && isKept(row.detector));
    const order = state.sort || `-cost_${state.profile}`;
    document.title = `${title} ${DASH} mjx_cl leaderboard`;
    const span = value => el("button", {type: "button", "aria-pressed": String(state.span === value), "data-focus": `span:${value}`,
      onclick: () => change({span: value})}, value ? "Around the onset" : "Whole stream");
    const seed = one => el("button", {type: "button", "aria-pressed": String(one === life), "data-focus": `seed:${one.seed}`,
      "aria-label": `seed ${one.seed}`, onclick: () => change({seed: one === found ? "" : String(one.seed)})}, String(one.seed));
    const which = lives.length < 2 ? "One seed." : `Seed ${life.seed}${isNull(life.target) ? "" : `, target ${life.target}`}.`;
    host.replaceChildren(
      el("nav", null, back, neighbour(data.faults[at - 1], "previous fault"), neighbour(data.faults[at + 1], "next fault")),
      el("h2", null, title), el("p", {class: "summary"}, summary(fault, alarms)),
      el("section", null, el("div", {class: "bar"}, span(""), span("near"), lives.length < 2 ? null : el("span", {id: "seeds", role: "group", "aria-label": "seed"}, "Seed ", lives.map(seed))),
        el("div", {id: "streams"}), el("div", {id: "alarms"}),
        el("p", {class: "foot"}, `${which} The upright line is the onset; marks are the first alarms from it on, hollow ones the first in the stretch before it`
          + `${others.length ? ", faint and small those of the other seeds" : ""}.`)),
      el("section", null, el("h3", null, "All seeds"), el("div", {class: "scroll", id: "own"},
        table("sort", columns.rows.filter(c => chosen(c) && !Object.hasOwn(choices, c.key)), sorted(own, order), order)), footnotes(own)));
    showStreams(fault, alarms, others);
  }

  /** First alarm of a detector in the stretch that is drawn before the onset, null without one. */
  const earlyOf = (life, name) => Object.hasOwn(life.early || {}, name) ? life.early[name] : null;

  function summary(fault, alarms) {
    const real = alarms.filter(([name]) => !references.has(name)), after = real.filter(([, step]) => !isNull(step)).sort((a, b) => a[1] - b[1]);
    const early = real.filter(([name]) => earlyOf(fault, name) !== null).length;
    const first = after.length ? `; the first is ${after[0][0]}, ${figure((after[0][1] - fault.onset) * fault.control_s, "number")} s after it` : "";
    return `The fault begins at step ${figure(fault.onset, "integer")} (${figure(fault.onset * fault.control_s, "number")} s). `
      + `In this seed ${after.length} of ${real.length} detectors alarm after the onset${first}.${early ? ` ${early} had alarmed in the stretch before it.` : ""}`;
  }

  function showStreams(fault, alarms, others) {
    const channels = new Map([...entries(fault.channels)].map(([name, packed]) => [name, halves(packed)]));
    const w = byId("streams").clientWidth, left = Math.min(150, 0.3 * w), right = w - Math.min(84, 0.2 * w);
    const every = fault.every || 1, first = fault.first || 0, time = step => (step - fault.onset) * fault.control_s;
    const longest = Math.max(0, ...[...channels.values()].map(values => values.length));
    const ends = [time(first), Math.max(time(first + every * Math.max(0, longest - 1)), ...alarms.map(([, step]) => time(step ?? fault.onset)))];
    const [low, high] = state.span === "near" ? [Math.max(NEAR_S[0], ends[0]), Math.min(NEAR_S[1], ends[1])] : ends;
    const x = scale(low, high, left, right), inside = t => t >= low && t <= high;
    const marks = alarms.filter(([name, step]) => !isNull(step) && isOn(name) && inside(time(step)));
    byId("streams").replaceChildren(...[...channels].map(([channel, values]) => {
      const h = 92, top = 10, bottom = h - 8;
      const points = values.map((v, k) => [time(first + k * every), v]).filter(([t]) => inside(t));
      const known = points.map(p => p[1]).filter(v => !isNull(v)), min = Math.min(...known), max = Math.max(...known);
      const y = scale(min, max > min ? max : min + 1, bottom, top);
      let pen = "M";
      const path = points.map(([t, v]) => {  // a gap in the stream is a gap in the line
        const out = isNull(v) ? "" : `${pen}${x(t).toFixed(1)} ${y(v).toFixed(1)}`;
        pen = isNull(v) ? "M" : "L";
        return out;
      }).join("");
      const svg = draw("svg", {width: w, height: h, class: "stream", role: "img", "aria-label": `${channel} over time`, "data-channel": channel},
        label(0, top + 10, shorten(channel, Math.floor(left / 7)), "title"));
      if (!known.length) return fill(svg, null, [label(left, h / 2, "no values", "tick")]);
      gridY(svg, ticks(min, max, 3), y, left, right);
      for (const [name, step] of marks) {
        svg.append(fill(line(x(time(step)), top, x(time(step)), bottom, "alarm-line"), {style: `stroke:${look(name).color}`}, []));
      }
      svg.append(draw("path", {d: path, class: "trace"}));
      if (inside(0)) svg.append(line(x(0), 0, x(0), h, "onset"));
      return svg;
    }));
    byId("alarms").replaceChildren(alarmLanes(fault, alarms, others, {w, left, right, low, high, x, inside, time}));
  }

  /** One lane per detector under the streams, on the same time axis; the earliest alarm after the onset first. */
  function alarmLanes(fault, alarms, others, {w, left, right, low, high, x, inside, time}) {
    const place = ([name, step]) => step ?? (earlyOf(fault, name) === null ? Number.MAX_VALUE : 1e12);
    const list = [...alarms].sort((a, b) => place(a) - place(b));
    const row = 20, top = 6, bottom = top + row * list.length;
    const svg = draw("svg", {width: w, height: bottom + 36, role: "group", "aria-label": "first alarm of each detector"});
    gridX(svg, ticks(low, high, Math.max(3, Math.floor((right - left) / 80))), x, top, bottom);
    svg.append(line(left, bottom, right, bottom, "axis"), label((left + right) / 2, bottom + 31, "seconds after the onset", "tick", "middle"));
    if (inside(0)) svg.append(line(x(0), 0, x(0), bottom, "onset"));
    list.forEach(([name, step], i) => {
      const at = top + row * (i + 0.5), early = earlyOf(fault, name), known = step ?? early, text = isNull(known) ? "no alarm" : seconds(time(known));
      const g = draw("g", {class: `lane${references.has(name) ? " reference" : ""}`, "data-name": name},
        label(left - 8, at + 4, shorten(name, Math.floor((left - 8) / 6.6)), "name", "end"), line(left, at, right, at, "rail"),
        label(right + 8, at + 4, text, isNull(step) ? "tick" : "name"));
      for (const one of others) {
        for (const [first, ink] of [[earlyOf(one, name), "fill:none;stroke"], [Object.hasOwn(one.alarms, name) ? one.alarms[name] : null, "fill"]]) {
          const late = isNull(first) ? null : (first - one.onset) * fault.control_s;
          if (late !== null && inside(late)) {
            g.append(draw("circle", {cx: x(late), cy: at, r: 2.5, class: "other", "aria-hidden": "true", style: `${ink}:${look(name).color}`}));
          }
        }
      }
      for (const [first, kind, side] of [[early, "early", "before the onset, false"], [step, "alarm", "after the onset"]]) {
        if (isNull(first) || !inside(time(first))) continue;
        const dot = fill(marker(name, x(time(first)), at, 4.5, kind === "early"), {class: kind}, []);
        g.append(tip(dot, [name, `first alarm at step ${figure(first, "integer")}`, `${seconds(time(first))} ${side}`], true));
      }
      svg.append(g);
    });
    return svg;
  }

  // ---- page ------------------------------------------------------------------------------------------------------------------------

  function build() {
    const select = (key, text, options) => el("label", null, el("span", null, text),
      el("select", {id: key, onchange: event => change({[key]: event.target.value})}, options.map(([value, name]) => el("option", {value}, name))));
    const any = key => [["", "all"], ...choices[key].map(value => [value, value])];
    const check = (key, value, off, text) => el("label", {class: "check"},
      el("input", {type: "checkbox", id: key, onchange: event => change({[key]: event.target.checked ? value : off})}), text);
    byId("board").replaceChildren(
      el("div", {class: "bar filters", role: "search"},
        select("profile", "Profile", Object.entries(data.profiles)), select("robot", "Robot", any("robot")), select("fault", "Fault", any("fault")),
        select("severity", "Severity", any("severity")),
        el("label", {class: "grow"}, el("span", null, "Search"),
          el("input", {id: "q", type: "search", placeholder: "detector, robot, fault, note", autocomplete: "off",
            oninput: event => change({q: event.target.value})})),
        check("refs", "", "no", "References"),
        el("button", {type: "button", id: "reset", onclick: () => change({...FIRST, show: null})}, "Reset")),
      el("section", null, el("h2", null, "Overall"),
        el("p", {class: "sub"}, "Means over all robots, faults and severities. The robot acts on the curves and the full table, fault, severity and "
          + "search on the full table."),
        el("div", {class: "scroll", id: "overall", tabindex: "0", role: "region", "aria-label": "overall table"}), el("div", {id: "overall-foot"})),
      el("section", null, el("h2", null, "Latency against false alarms"),
        el("p", {class: "sub"}, "Each point is one threshold; down and left is better. Hollow: fewer than half of the faults detected. "
          + "Names switch curves on and off."),
        el("div", {id: "legend", class: "legend", role: "group", "aria-label": "detectors shown"}), el("div", {id: "curves", class: "charts"}),
        el("h2", null, "Scores and ranks"),
        el("p", {class: "sub"}, "Bars are 95 % intervals. Ranks inside the shaded band cannot be told from the best one; arrows stand for values "
          + "off the scale; names that are switched off are hollow."),
        el("div", {id: "intervals", class: "charts"})),
      el("section", null, el("h2", null, "Every robot, fault and severity"),
        el("div", {class: "bar"}, el("span", {id: "count", role: "status"}), check("cols", "all", "", "All columns")),
        el("div", {class: "scroll tall", id: "full", tabindex: "0", role: "region", "aria-label": "full table"}),
        el("button", {type: "button", id: "more", onclick: () => { allRows = true; render(); }}), el("div", {id: "full-foot"})),
      el("section", {id: "pages"}));
    about();
  }

  function faultLinks() {
    const robots = distinct(data.faults.map(fault => fault.robot));
    const link = fault => el("a", {href: pathOf([fault.robot, fault.fault, fault.severity])}, `${fault.fault} ${figure(fault.severity, "number")}`);
    byId("pages").replaceChildren(el("h2", null, "Streams fault by fault"), ...robots.map(robot => el("div", {class: "chips"},
      el("strong", null, robot), data.faults.filter(fault => String(fault.robot) === robot).map(link))));
    byId("pages").hidden = !robots.length;
  }

  /** What the figures rest on, from meta as it came. */
  function about() {
    const plain = value => {
      if (Array.isArray(value)) return value.map(plain).join(", ");
      if (value && typeof value === "object") return Object.entries(value).map(([k, v]) => `${k} ${plain(v)}`).join(", ");
      return isNull(value) ? DASH : String(value);
    };
    const {notes, critical_difference: cd, ...rest} = data.meta;
    const items = Object.entries({...rest, ...(isNull(cd) ? {} : {critical_difference: figure(cd, "number")})});
    byId("about").replaceChildren(el("h2", null, "How the figures were made"),
      el("dl", null, items.map(([key, value]) => [el("dt", null, key.replaceAll("_", " ")),
        el("dd", null, key === "command" ? el("code", null, plain(value)) : plain(value))])),
      ...[notes || []].flat().map(note => el("p", null, plain(note))));
  }

  function render() {
    const held = document.activeElement && document.activeElement.dataset.focus, scrolled = byId("full").scrollLeft;
    byId("board").hidden = route !== null;
    byId("page").hidden = route === null;
    byId("tip").hidden = true;
    document.title = "mjx_cl leaderboard";
    if (route) {
      showFault();
    } else {
      for (const key of ["profile", ...Object.keys(choices), "q"]) if (byId(key).value !== state[key]) byId(key).value = state[key];
      byId("refs").checked = state.refs !== "no";
      byId("cols").checked = state.cols === "all";
      showTables();
      byId("full").scrollLeft = scrolled;
      showLegend();
      showCurves();
      showIntervals();
      faultLinks();
    }
    if (held) {  // a header that was pressed by key keeps the focus
      const again = [...document.querySelectorAll("[data-focus]")].find(node => node.dataset.focus === held);
      if (again) again.focus({preventScroll: true});
    }
  }

  function arrive() {
    const before = JSON.stringify(route);
    parse(location.hash.slice(1));
    render();
    if (before !== JSON.stringify(route)) window.scrollTo(0, 0);
  }

  build();
  arrive();
  window.addEventListener("hashchange", arrive);
  let width = window.innerWidth;
  window.addEventListener("resize", () => {
    if (width !== (width = window.innerWidth)) render();  // a phone's address bar changes the height alone
  });
})();
