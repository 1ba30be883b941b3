"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const { labels, colors } = data, all = labels.map((_, m) => m);
  const on = new Set(all);
  const find = (id) => document.getElementById(id);
  const config = { responsive: true, displaylogo: false, displayModeBar: false };
  const quiet = { gridcolor: "#e4e4e4", zerolinecolor: "#e4e4e4", linecolor: "#bbbbbb", automargin: true };
  const dashes = ["solid", "dash", "dot", "dashdot"];
  let motion, axes, moment = 1, playing = 0;

  // Plotly reads a subset of HTML in its texts: names are to be seen as they are, long ones shortened.
  const plain = (text) => (text.length > 32 ? `${text.slice(0, 15)}…${text.slice(-15)}` : text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
  const floats = (text) => Array.from(new Float32Array(bytes(text)), (value) => (isNaN(value) ? null : value));

  /** Positions as [path][coordinate][point], null where there is none. */
  function unpack(text, count, n, low, high) {
    const whole = new Int16Array(bytes(text));
    const points = whole.length / count / n;
    return Array.from({ length: count }, (_, b) =>
      Array.from({ length: n }, (_, k) =>
        Array.from({ length: points }, (_, i) => {
          const value = whole[(b * points + i) * n + k];
          return value === -32768 ? null : low[k] + ((value + 32767) / 65534) * (high[k] - low[k]);
        })));
  }

  /** A motion with its numbers unpacked, once. */
  function opened(told) {
    if (told.open) return told;
    told.grid = floats(told.grid);
    told.shown = unpack(told.shown, told.shown_durations.length, told.dim, told.low, told.high);
    told.shown_speed = floats(told.shown_speed);
    for (const one of told.methods.filter(Boolean)) {
      one.paths = unpack(one.paths, told.durations.length, told.dim, told.low, told.high);
      one.speed = floats(one.speed);
    }
    told.open = true;
    return told;
  }

  const movers = () => all.filter((m) => motion.methods[m] && on.has(m));
  const timesOf = (duration) => motion.grid.map((share) => share * duration);
  const longest = () => Math.max(...motion.shown_durations);

  /** What the chosen axes show of a path: [x, y] or [x, y, z]. */
  function seen(path, duration) {
    return motion.dim === 1 ? [timesOf(duration), path[0]] : axes.map((k) => path[k]);
  }

  function joined(parts) {
    const out = axesNames().map(() => []);
    for (const part of parts) part.forEach((values, k) => { for (const value of values) out[k].push(value); out[k].push(null); });
    return out;
  }

  const axesNames = () => (motion.dim === 1 || axes.length === 2 ? ["x", "y"] : ["x", "y", "z"]);
  const asTrace = (parts) => Object.fromEntries(axesNames().map((name, k) => [name, parts[k]]));

  /** Where a path is at so many seconds, between its points. */
  function place(path, duration, seconds) {
    const share = Math.min(1, seconds / duration);
    let i = motion.grid.findIndex((value) => value >= share);
    if (i < 0) i = motion.grid.length - 1;
    const j = Math.max(0, i - 1), span = motion.grid[i] - motion.grid[j];
    const part = span > 0 ? (share - motion.grid[j]) / span : 1;
    const parts = seen(path, duration);
    return { i, at: parts.map((values) => (values[i] === null || values[j] === null ? null : values[j] + part * (values[i] - values[j]))) };
  }

  /** The traces that move: for each method the way so far from the demonstrated start, and where every motion is. */
  function moving() {
    const seconds = moment * longest(), trails = [], spots = [];
    for (const m of movers()) {
      const { paths } = motion.methods[m];
      const places = paths.map((path, b) => place(path, motion.durations[b], seconds));
      trails.push(joined(paths.filter((_, b) => motion.own[b]).map((path) => {
        const b = paths.indexOf(path);
        return seen(path, motion.durations[b]).map((values, k) => [...values.slice(0, places[b].i), places[b].at[k]]);
      })));
      spots.push(axesNames().map((_, k) => places.map((one) => one.at[k])));
    }
    return { trails, spots };
  }

  let trailsAt = [], spotsAt = [];
  function drawReplications() {
    const solid = axesNames().length === 3, type = solid ? "scatter3d" : "scatter", traces = [];
    const line = (width, color, more) => ({ width: solid ? width * 2 : width, color, ...more });
    const add = (parts, more) => traces.push({ type, ...asTrace(parts), hoverinfo: "skip", showlegend: false, ...more }) - 1;
    const shown = motion.shown.map((path, i) => seen(path, motion.shown_durations[i]));
    for (const m of movers()) {
      const { paths } = motion.methods[m];
      add(joined(paths.map((path, b) => seen(path, motion.durations[b]))), { mode: "lines", line: line(1, colors[m]), opacity: 0.3, connectgaps: false });
    }
    const { trails, spots } = moving();
    trailsAt = movers().map((m, i) => add(trails[i], { mode: "lines", line: line(2.5, colors[m]), name: plain(labels[m]), hoverinfo: "name" }));
    add(joined(shown), { mode: "lines", line: line(2, data.shown, { dash: "dash" }), name: "demonstration", hoverinfo: "name" });
    spotsAt = movers().map((m, i) => add(spots[i], { mode: "markers", marker: { size: solid ? 3.5 : 6, color: colors[m] } }));
    const ends = (i) => axesNames().map((_, k) => shown.map((parts) => parts[k].at(i)));
    add(ends(0), { mode: "markers", marker: { size: solid ? 5 : 9, color: data.shown, symbol: "circle" }, name: "start", hoverinfo: "name" });
    add(ends(-1), { mode: "markers", marker: { size: solid ? 7 : 13, color: "#E69F00", symbol: solid ? "diamond" : "star", line: { color: data.shown, width: 1 } }, name: "goal", hoverinfo: "name" });
    const title = (k) => ({ text: motion.dim === 1 ? ["time [s]", plain(motion.columns[0])][k] : plain(motion.columns[axes[k]]) });
    const layout = { margin: { l: 0, r: 0, t: 0, b: 0 }, uirevision: motion.name + axes, showlegend: false, hovermode: "closest" };
    if (solid) {
      const far = innerWidth < 600 ? 1.15 : 1; // room for the names of axes
      const axis = (k) => ({ ...quiet, title: title(k), showbackground: false, nticks: 5, showspikes: false });
      layout.scene = { xaxis: axis(0), yaxis: axis(1), zaxis: axis(2), aspectmode: motion.dim === 3 ? "data" : "cube", camera: { eye: { x: 1.6 * far, y: -1.9 * far, z: 1.05 * far }, center: { x: 0, y: 0, z: -0.12 } }, uirevision: motion.name };
    } else {
      layout.margin = { l: 10, r: 10, t: 10, b: 10 };
      layout.xaxis = { ...quiet, title: title(0), zeroline: false };
      layout.yaxis = { ...quiet, title: title(1), zeroline: false, ...(motion.dim === 2 ? { scaleanchor: "x" } : {}) };
    }
    // Before the picture is drawn: it takes the height that this leaves.
    const gone = movers().filter((m) => motion.methods[m].gone);
    const some = motion.starts.drawn < motion.starts.of ? `${motion.starts.drawn} of ${motion.starts.of} motions are drawn. ` : "";
    find("drawn").textContent = (solid ? "Drag to turn, scroll or pinch to zoom. " : "") +
      "Bold: from the demonstrated start. Dashed: the demonstration. " + some +
      gone.map((m) => `${labels[m]}: ${motion.methods[m].gone} of ${motion.starts.of} motions leave the picture. `).join("");
    tellTime();
    return Plotly.react("replications", traces, layout, config);
  }

  function tellTime() { find("clock").textContent = `${(moment * longest()).toFixed(2)} s`; }

  function move() {
    const { trails, spots } = moving(), names = axesNames();
    const at = [...trailsAt, ...spotsAt], parts = [...trails, ...spots];
    if (at.length) Plotly.restyle("replications", Object.fromEntries(names.map((name, k) => [name, parts.map((one) => one[k])])), at);
    tellTime();
  }

  function play(go) {
    cancelAnimationFrame(playing);
    playing = 0;
    find("play").textContent = go ? "Pause" : "Play";
    if (!go) return;
    if (moment >= 1) moment = 0;
    const seconds = Math.min(8, Math.max(3, longest()));
    let before = performance.now();
    const step = (now) => {
      moment = Math.min(1, moment + (now - before) / 1000 / seconds);
      before = now;
      find("moment").value = 1000 * moment;
      move();
      if (moment >= 1) play(false); else playing = requestAnimationFrame(step);
    };
    playing = requestAnimationFrame(step);
  }

  /** 1, 2, 5, 10, … around two numbers > 0; powers of ten alone if they are far apart. */
  function ticks(low, high) {
    const steps = high > 300 * low ? [1] : [1, 2, 5], found = [];
    for (let k = Math.floor(Math.log10(low)); k <= Math.ceil(Math.log10(high)); k++) for (const step of steps) found.push(Number(`${step}e${k}`));
    return found;
  }

  function drawDistances() {
    const traces = [], chosen = all.filter((m) => on.has(m) && motion.scores[m]), names = chosen.map((m) => plain(labels[m]));
    const mean = (values) => (values.length && !values.includes(null) ? values.reduce((a, b) => a + b, 0) / values.length : null);
    const around = chosen.map((m) => motion.scores[m].others), own = chosen.map((m) => motion.scores[m].own);
    const judged = around.map((values, i) => (values.length ? values : own[i]));
    const means = judged.map(mean);
    const spread = judged.map((values, i) => (values.length > 1 && means[i] !== null ? Math.sqrt(values.reduce((sum, value) => sum + (value - means[i]) ** 2, 0) / (values.length - 1)) : 0));
    const known = [...judged, ...own].flat().filter((value) => value > 0);
    const low = Math.min(...known), high = Math.max(...known), log = high > 20 * low;
    // On a log scale mean - sd may lie below zero: the whisker then ends at the smallest score.
    const down = spread.map((sd, i) => (log ? means[i] - Math.max(means[i] - sd, Math.min(means[i], ...judged[i].filter((value) => value !== null))) : Math.min(sd, means[i])));
    traces.push({ type: "bar", x: chosen.map((_, i) => i), y: means, hovertext: names, marker: { color: chosen.map((m) => colors[m]), opacity: 0.8 }, error_y: { type: "data", array: spread, arrayminus: down, symmetric: false, color: data.shown, thickness: 1.4 }, hovertemplate: "%{hovertext}: %{y:.3g} %<extra></extra>", width: 0.6 });
    const place = [], dots = [];
    around.forEach((values, i) => values.forEach((value, j) => { place.push(i + 0.4 * (values.length > 1 ? j / (values.length - 1) - 0.5 : 0)); dots.push(value); }));
    traces.push({ type: "scatter", mode: "markers", x: place, y: dots, marker: { color: data.shown, size: 4, opacity: 0.4 }, hovertemplate: "%{y:.3g} %<extra>a start</extra>" });
    if (around.some((values) => values.length)) traces.push({ type: "scatter", mode: "markers", x: own.flatMap((values, i) => values.map(() => i)), y: own.flat(), marker: { color: "white", size: 10, symbol: "diamond", line: { color: data.shown, width: 1.5 } }, hovertemplate: "%{y:.3g} %<extra>the demonstrated start</extra>" });
    return Plotly.react("distances", traces, {
      margin: { l: 10, r: 10, t: 10, b: 10 }, showlegend: false, bargap: 0.4,
      xaxis: { ...quiet, range: [-0.5, chosen.length - 0.5], tickvals: chosen.map((_, i) => i), ticktext: names, zeroline: false },
      yaxis: { ...quiet, type: log ? "log" : "linear", title: { text: "distance [% of the size]" }, ...(log ? { tickvals: ticks(low, high), range: [Math.log10(low) - 0.3, Math.log10(high) + 0.15] } : { rangemode: "tozero" }) },
    }, config);
  }

  const shownLine = (x, y, more) => ({ type: "scatter", mode: "lines", x, y, name: "demonstration", line: { color: "#c8c8c8", width: 6 }, ...more });
  const ownLine = (m, x, y, more) => ({ type: "scatter", mode: "lines", x, y, name: plain(labels[m]), line: { color: colors[m], width: 1.8, dash: dashes[m % dashes.length] }, ...more });

  function drawSpeeds() {
    const times = timesOf(motion.durations[0]);
    const traces = [shownLine(timesOf(motion.shown_durations[0]), motion.shown_speed)];
    for (const m of movers()) traces.push(ownLine(m, times, motion.methods[m].speed));
    // One wild fit is not to flatten all others: three times the largest demonstrated speed is seen.
    const limit = 3 * Math.max(...motion.shown_speed), top = Math.max(...traces.flatMap((trace) => trace.y));
    return Plotly.react("speeds", traces, {
      margin: { l: 10, r: 10, t: 10, b: 10 }, showlegend: true, legend: { orientation: "h", y: 1.02, yanchor: "bottom" }, hovermode: "x unified",
      xaxis: { ...quiet, title: { text: "time [s]" }, zeroline: false }, yaxis: { ...quiet, title: { text: "speed [units / s]" }, range: [0, 1.05 * Math.min(top, limit)] },
    }, config);
  }

  function drawJoints() {
    const count = Math.min(motion.dim, 24), columns = innerWidth > 900 && count > 3 ? 2 : 1, rows = Math.ceil(count / columns);
    find("coordinate-note").textContent = count < motion.dim ? `The first ${count} of ${motion.dim}.` : "";
    const traces = [], layout = { margin: { l: 10, r: 10, t: 10, b: 10 }, showlegend: true, legend: { orientation: "h", y: 1.01, yanchor: "bottom" }, hovermode: "x unified", grid: { rows, columns, pattern: "independent", ygap: rows > 1 ? 0.12 : 0, xgap: 0.1 } };
    for (let k = 0; k < count; k++) {
      const id = k ? k + 1 : "", more = { xaxis: `x${id}`, yaxis: `y${id}`, showlegend: !k };
      motion.shown.forEach((path, i) => traces.push(shownLine(timesOf(motion.shown_durations[i]), path[k], { ...more, showlegend: !k && !i })));
      for (const m of movers()) traces.push(ownLine(m, timesOf(motion.durations[0]), motion.methods[m].paths[0][k], more));
      layout[`xaxis${id}`] = { ...quiet, zeroline: false, ...(k >= count - columns ? { title: { text: "time [s]" } } : { showticklabels: false }) };
      layout[`yaxis${id}`] = { ...quiet, zeroline: false, nticks: 5, title: { text: plain(motion.columns[k]) } };
    }
    layout.height = 60 + (count === 1 ? 300 : 150) * rows;
    return Plotly.react("joints", traces, layout, config);
  }

  function chooseAxes() {
    const box = find("coordinates");
    box.replaceChildren();
    box.hidden = motion.dim <= 3;
    axes = Array.from({ length: Math.min(3, motion.dim) }, (_, k) => k);
    if (motion.dim <= 3) return;
    ["x", "y", "z"].forEach((name, i) => {
      const label = document.createElement("label"), select = document.createElement("select");
      motion.columns.forEach((column, k) => select.append(new Option(column, k, k === axes[i], k === axes[i])));
      select.addEventListener("change", () => { axes[i] = Number(select.value); drawReplications(); });
      label.append(`${name} `, select);
      box.append(label);
    });
  }

  /** All pictures; the page says when they are there. */
  function draw() {
    delete document.body.dataset.drawn;
    Promise.all([drawReplications(), drawDistances(), drawSpeeds(), drawJoints()]).then(() => { document.body.dataset.drawn = motion.name; });
  }

  function choose(i) {
    play(false);
    motion = opened(data.motions[i]);
    chooseAxes();
    draw();
  }

  for (const box of document.querySelectorAll("[data-method]")) {
    box.addEventListener("change", () => {
      const m = Number(box.dataset.method);
      if (box.checked) on.add(m); else on.delete(m);
      draw();
    });
  }
  find("motion").addEventListener("change", (event) => choose(Number(event.target.value)));
  find("play").addEventListener("click", () => play(!playing));
  find("moment").addEventListener("input", (event) => { play(false); moment = event.target.value / 1000; move(); });

  for (const table of document.querySelectorAll("table.sortable")) {
    const heads = [...table.tHead.rows[0].cells], body = table.tBodies[0];
    heads.forEach((head, k) => head.firstElementChild.addEventListener("click", () => {
      const way = head.ariaSort === "ascending" ? -1 : 1;
      heads.forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", way > 0 ? "ascending" : "descending");
      const value = (row) => row.cells[k].dataset.value;
      const number = (text) => (text === "inf" ? Infinity : text === "nan" ? NaN : Number(text));
      const compared = (a, b) => {
        const [first, second] = [number(value(a)), number(value(b))];
        if (k === 0) return way * value(a).localeCompare(value(b), undefined, { numeric: true });
        return isNaN(first) || isNaN(second) ? isNaN(first) - isNaN(second) : first === second ? 0 : way * (first < second ? -1 : 1);
      };
      body.append(...[...body.rows].sort(compared));
    }));
  }

  choose(0);
})();
