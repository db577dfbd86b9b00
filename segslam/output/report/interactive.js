"use strict";
(async () => {
  const find = (id) => document.getElementById(id);
  const data = JSON.parse(find("topview-data").textContent);
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  try {
    const packed = new Blob([bytes(find("plotly-packed").textContent)]);
    const source = await new Response(packed.stream().pipeThrough(new DecompressionStream("gzip"))).text();
    const script = document.createElement("script");
    script.text = source;
    document.head.append(script);
  } catch (error) {
    find("topview").textContent = "This browser is too old for the interactive view (" + error + ").";
    return;
  }
  const colours = { accepted: "#009E73", "rejected by the optimiser": "#D55E00", rejected: "#7F7F7F" };
  const axis = { zeroline: false, automargin: true };
  const layout = (more) => ({
    margin: { l: 50, r: 30, t: 40, b: 40 }, hovermode: "closest", dragmode: "pan", font: { size: 13 },
    legend: { orientation: "h", y: 1.02, yanchor: "bottom" }, modebar: { orientation: "v" },
    xaxis: { ...axis, title: { text: "x (m)" } },
    yaxis: { ...axis, title: { text: "y (m)" }, scaleanchor: "x" }, ...more,
  });
  const narrow = window.innerWidth < 640;  // there the buttons would cover the legend, and fingers do what they do
  const config = { scrollZoom: true, responsive: true, displaylogo: false, displayModeBar: narrow ? false : "hover" };

  const lines = data.paths.map((path) => ({
    type: "scatter", mode: "lines", name: path.name, x: path.x, y: path.y, hoverinfo: "skip",
    line: { color: path.color, width: path.name === "truth" ? 4 : 1.5, dash: path.name === "odometry" ? "dash" : "solid" },
  }));
  const corrected = data.paths[data.paths.length - 1];
  const names = Object.keys(data.values).filter((name) => name !== "scan");
  const dots = {
    type: "scatter", mode: "markers", name: "scans", x: corrected.x, y: corrected.y, showlegend: false,
    customdata: data.values.scan.map((scan, row) => [scan, ...names.map((name) => data.values[name][row])]),
    hovertemplate: "scan %{customdata[0]}" + names.map((name, k) => `<br>${name}: %{customdata[${k + 1}]}`).join("") +
      "<extra></extra>",
    marker: { size: 5, colorscale: "Viridis", colorbar: { thickness: 12 } },
  };
  const traces = [...lines, dots];
  const loopTraces = new Map();
  for (const kind of Object.keys(colours)) {
    const loops = data.loops.filter((loop) => loop.kind === kind);
    if (!loops.length) continue;
    const x = [], y = [];
    for (const { ends } of loops) {
      x.push(ends[0][0], ends[1][0], null);
      y.push(ends[0][1], ends[1][1], null);
    }
    const visible = kind === "rejected" ? "legendonly" : true;
    traces.push({
      type: "scatter", mode: "lines", x, y, hoverinfo: "skip", showlegend: false, legendgroup: kind, visible,
      line: { color: colours[kind], width: 1 },
    });
    loopTraces.set(traces.length, loops);
    traces.push({
      type: "scatter", mode: "markers", name: `loops ${kind} (${loops.length})`, legendgroup: kind, visible,
      x: loops.map(({ ends }) => (ends[0][0] + ends[1][0]) / 2),
      y: loops.map(({ ends }) => (ends[0][1] + ends[1][1]) / 2),
      text: loops.map((loop) => `keyframes ${loop.name}<br>${loop.text.replace(/, /g, "<br>")}`),
      hovertemplate: "%{text}<extra></extra>",
      marker: { size: 10, symbol: "diamond", color: colours[kind], line: { color: "white", width: 1 } },
    });
  }
  const view = find("topview");
  await Plotly.newPlot(view, traces, layout({ height: Math.min(700, Math.max(420, window.innerHeight * 0.75)) }), config);

  const chooser = find("colour");
  for (const name of names) chooser.add(new Option(name, name));
  const paint = () => Plotly.restyle(view, {
    "marker.color": [data.values[chooser.value]], "marker.colorbar.title.text": chooser.value,
  }, [lines.length]);
  chooser.onchange = paint;
  await paint();

  const cloud = (number, rows) => {
    const whole = new Int16Array(bytes(data.clouds[number]).buffer);
    const x = [], y = [], T = rows || [1, 0, 0, 0, 0, 1, 0, 0];
    for (let k = 0; k < whole.length; k += 3) {
      const [a, b, c] = [0, 1, 2].map((j) => whole[k + j] * data.step_m);
      x.push(T[0] * a + T[1] * b + T[2] * c + T[3]);
      y.push(T[4] * a + T[5] * b + T[6] * c + T[7]);
    }
    return { x, y };
  };
  const show = async (loop) => {
    const box = find("pair");
    box.replaceChildren();
    const title = document.createElement("h3");
    title.textContent = `keyframes ${loop.name}: ${loop.text}`;
    box.append(title);
    if (!loop.pair) {
      box.append("The clouds of this pair are not part of this page; see the log in Foxglove.");
      return;
    }
    const panels = ["before: by odometry", "after: in the final map"].map((name) => {
      const [panel, heading, plot] = ["div", "h4", "div"].map((kind) => document.createElement(kind));
      panel.className = "panel";
      heading.textContent = name;
      panel.append(heading, plot);
      box.append(panel);
      return plot;
    });
    for (const [k, rows] of [loop.before, loop.after].entries()) {
      const dot = (points, colour, label) => ({
        type: "scatter", mode: "markers", name: label, ...points, hoverinfo: "skip", marker: { size: 3, color: colour },
      });
      await Plotly.newPlot(panels[k], [
        dot(cloud(loop.pair[1]), "#4D4D4D", `keyframe ${loop.pair[1]}`),
        dot(cloud(loop.pair[0], rows), "#D55E00", `keyframe ${loop.pair[0]}`),
      ], layout({ height: 420 }), { ...config, displayModeBar: false });
    }
    box.scrollIntoView({ behavior: "smooth", block: "nearest" });
  };
  view.on("plotly_click", ({ points }) => {
    const loops = loopTraces.get(points[0].curveNumber);
    if (loops) show(loops[points[0].pointNumber]);
  });
  view.dataset.ready = "yes";
})();
