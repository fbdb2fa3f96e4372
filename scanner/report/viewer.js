"use strict";

// A picture opens large in a dialog, and closes with a click or Escape.
for (const map of document.querySelectorAll(".grid svg.map, .beside svg.map")) {
  map.addEventListener("click", () => {
    const dialog = document.createElement("dialog");
    dialog.append(map.closest("figure").cloneNode(true));
    dialog.addEventListener("click", () => dialog.close());
    dialog.addEventListener("close", () => dialog.remove());
    document.body.append(dialog);
    dialog.showModal();
  });
}

// The point cloud: records of 12 bytes (int16 x y z, grey, σ, region, int8 normal) drawn as discs as wide as the
// distance between neighbours, so that a surface looks closed. Without WebGL the still picture stays.
(function pointCloud() {
  const figure = document.getElementById("viewer");
  if (!figure) return;
  const stage = figure.querySelector(".stage");
  const canvas = figure.querySelector("canvas");
  const gl = canvas.getContext("webgl", { antialias: true, preserveDrawingBuffer: true });
  if (!gl) return;

  const cloud = JSON.parse(document.getElementById("cloud").textContent);
  const bytes = Uint8Array.from(atob(document.getElementById("records").textContent), (c) => c.charCodeAt(0));
  const MODES = { shape: 0, grey: 1, depth: 2, sigma: 3, region: 4 };
  const PALETTE_OF = { depth: "cividis", sigma: "viridis" };
  const FIELD_OF_VIEW = (28 * Math.PI) / 180;

  const VERTEX = `
    attribute vec3 position; attribute vec3 normal; attribute vec3 level;  // level: grey, σ, region
    uniform mat4 view; uniform mat4 projection; uniform float quantum, diameter; uniform int mode;
    uniform vec2 depthRange; uniform float centreZ; uniform vec3 palette[32];
    varying vec3 colour;
    vec3 paint(float t) {
      float at = clamp(t, 0.0, 1.0) * 31.0;
      vec3 below = palette[0], above = palette[0];
      for (int i = 0; i < 32; i++) {
        if (float(i) == floor(at)) below = palette[i];
        if (float(i) == min(floor(at) + 1.0, 31.0)) above = palette[i];
      }
      return mix(below, above, fract(at));
    }
    void main() {
      vec3 mm = position * quantum;
      vec4 seen = view * vec4(mm, 1.0);
      gl_Position = projection * seen;
      gl_PointSize = clamp(diameter / gl_Position.w, 1.5, 24.0);
      vec3 facing = mat3(view) * normalize(normal);
      if (dot(facing, seen.xyz) > 0.0) facing = -facing;  // both sides of a surface are lit
      float light = max(0.0, dot(facing, vec3(-0.31, 0.36, 0.88)));
      float shade = 0.18 + 0.82 * light;
      if (mode == 0) colour = vec3(0.80, 0.83, 0.87) * shade;
      else if (mode == 1) colour = vec3(pow(level.x, 0.8));
      else if (mode == 2) colour = paint((mm.z + centreZ - depthRange.x) / (depthRange.y - depthRange.x)) * (0.45 + 0.55 * light);
      else if (mode == 3) colour = paint(level.y);
      else colour = (level.z > 0.0 ? vec3(0.93, 0.18, 0.27) : vec3(0.66, 0.71, 0.77)) * shade;
    }`;
  const FRAGMENT = `
    precision mediump float;
    varying vec3 colour;
    void main() {
      vec2 off = gl_PointCoord - 0.5;
      if (dot(off, off) > 0.25) discard;
      gl_FragColor = vec4(colour, 1.0);
    }`;

  function compiled(kind, source) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    return shader;
  }
  const program = gl.createProgram();
  gl.attachShader(program, compiled(gl.VERTEX_SHADER, VERTEX));
  gl.attachShader(program, compiled(gl.FRAGMENT_SHADER, FRAGMENT));
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  gl.useProgram(program);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, bytes, gl.STATIC_DRAW);
  const layout = [["position", gl.SHORT, false, 0], ["level", gl.UNSIGNED_BYTE, true, 6], ["normal", gl.BYTE, true, 9]];
  for (const [name, type, normalised, offset] of layout) {
    const place = gl.getAttribLocation(program, name);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, 3, type, normalised, 12, offset);
  }
  const uniform = (name) => gl.getUniformLocation(program, name);
  const at = {};
  for (const name of ["view", "projection", "quantum", "diameter", "mode", "depthRange", "centreZ", "palette"]) at[name] = uniform(name);
  gl.uniform1f(at.quantum, cloud.step_mm);
  gl.uniform2f(at.depthRange, cloud.depth_mm[0], Math.max(cloud.depth_mm[1], cloud.depth_mm[0] + 1e-3));
  gl.uniform1f(at.centreZ, cloud.centre[2]);
  gl.enable(gl.DEPTH_TEST);

  // The observer: turned about a target (mm from the centre), at a distance. Camera y and z are flipped to GL's.
  const size = Math.hypot(...cloud.extent_mm);
  let yaw, pitch, distance, target, mode = "shape";
  function reset() {
    [yaw, pitch, target] = [0.35, 0.25, [0, 0, 0]];
    const wide = Math.min(1.6, canvas.clientWidth / canvas.clientHeight || 1.6);
    distance = (0.38 * Math.max(size, 1e-3)) / Math.tan(FIELD_OF_VIEW / 2) * Math.max(1, 1.3 / wide);
  }

  function rotation() {
    const [a, b, c, d] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    // Rx(pitch) Ry(yaw) diag(1, −1, −1), rows.
    return [[a, 0, -b], [d * b, -c, d * a], [-c * b, -d, -c * a]];
  }
  function viewMatrix() {
    const R = rotation();
    const t = R.map((row) => -(row[0] * target[0] + row[1] * target[1] + row[2] * target[2]));
    return new Float32Array([
      R[0][0], R[1][0], R[2][0], 0, R[0][1], R[1][1], R[2][1], 0, R[0][2], R[1][2], R[2][2], 0, t[0], t[1], t[2] - distance, 1,
    ]);
  }
  const mmPerPixel = () => (2 * distance * Math.tan(FIELD_OF_VIEW / 2)) / canvas.clientHeight;

  let wanted = false;
  function redraw() {
    if (!wanted) requestAnimationFrame(draw);
    wanted = true;
  }
  function draw() {
    wanted = false;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
    if (!width || !height) return;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.viewport(0, 0, width, height);
    const ground = getComputedStyle(stage).backgroundColor.match(/[\d.]+/g).map(Number);
    gl.clearColor(ground[0] / 255, ground[1] / 255, ground[2] / 255, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const f = 1 / Math.tan(FIELD_OF_VIEW / 2);
    const [near, far] = [Math.max(distance - 2 * size, 0.02 * distance), distance + 2 * size];
    gl.uniformMatrix4fv(at.projection, false, new Float32Array([
      (f * height) / width, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, (2 * far * near) / (near - far), 0,
    ]));
    gl.uniformMatrix4fv(at.view, false, viewMatrix());
    gl.uniform1f(at.diameter, (1.5 * cloud.spacing_mm * f * height) / 2);
    gl.uniform1i(at.mode, MODES[mode]);
    gl.uniform3fv(at.palette, new Float32Array(cloud.palette[PALETTE_OF[mode] || "viridis"]));
    gl.drawArrays(gl.POINTS, 0, cloud.count);
    drawScale();
    drawAxes();
  }

  function drawScale() {
    const bar = figure.querySelector(".scalebar");
    const most = 150 * mmPerPixel();
    const decade = 10 ** Math.floor(Math.log10(most));
    const mm = decade * [5, 2, 1].find((step) => step * decade <= most);
    bar.style.width = `${mm / mmPerPixel()}px`;
    bar.textContent = mm >= 1 ? `${mm} mm` : `${+(1000 * mm).toPrecision(1)} µm`;
  }
  function drawAxes() {
    const R = rotation();
    const axes = [["x", "#d1495b"], ["y", "#3a9d5d"], ["z", "#3f7fd0"]].map(([name, colour], i) => ({ name, colour, x: R[0][i], y: -R[1][i], z: R[2][i] }));
    axes.sort((p, q) => p.z - q.z);
    figure.querySelector(".axes").innerHTML = axes.map((e) =>
      `<line x1="38" y1="38" x2="${38 + 26 * e.x}" y2="${38 + 26 * e.y}" stroke="${e.colour}"/>` +
      `<text x="${38 + 34 * e.x}" y="${38 + 34 * e.y}">${e.name}</text>`).join("");
  }
  function drawLegend() {
    const legend = figure.querySelector(".legend");
    const range = { depth: cloud.depth_mm, sigma: cloud.sigma_mm }[mode];
    if (range) {
      const flat = cloud.palette[PALETTE_OF[mode]];
      const stops = Array.from({ length: 32 }, (_, i) => `rgb(${flat.slice(3 * i, 3 * i + 3).map((v) => Math.round(255 * v)).join(" ")})`);
      const label = mode === "depth" ? "depth z, mm" : "predicted σ, mm, logarithmic";
      legend.innerHTML = `${label}<i style="background:linear-gradient(90deg,${stops})"></i><span>${range[0].toPrecision(4)}</span><span>${range[1].toPrecision(4)}</span>`;
    } else {
      legend.textContent = mode === "region" ? "red: a bounce was detected here" : "";
    }
  }

  // Hands: pointers (one orbits, Shift or another button or two move, two pinch), wheel, keys.
  const pointers = new Map();
  function move(dx, dy) {
    const R = rotation();
    for (let i = 0; i < 3; i++) target[i] -= mmPerPixel() * (dx * R[0][i] - dy * R[1][i]);
  }
  function orbit(dx, dy) {
    yaw += 0.008 * dx;
    pitch = Math.max(-1.57, Math.min(1.57, pitch + 0.008 * dy));
  }
  function zoom(factor) {
    distance = Math.max(0.02 * size, Math.min(20 * size, distance * factor));
  }
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last) return;
    const [dx, dy] = [event.clientX - last[0], event.clientY - last[1]];
    const others = [...pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    if (others.length) {
      const apart = (place) => Math.hypot(place[0] - others[0][0], place[1] - others[0][1]) || 1;
      zoom(apart(last) / apart([event.clientX, event.clientY]));
      move(dx / 2, dy / 2);
    } else if (event.shiftKey || event.buttons & 6) {
      move(dx, dy);
    } else {
      orbit(dx, dy);
    }
    redraw();
  });
  for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas && !event.ctrlKey) return; // leave the page its scrolling until clicked
    event.preventDefault();
    zoom(Math.exp(0.0015 * event.deltaY * (event.deltaMode ? 20 : 1)));
    redraw();
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const step = event.shiftKey ? move : orbit;
    const keys = {
      ArrowLeft: () => step(-15, 0), ArrowRight: () => step(15, 0), ArrowUp: () => step(0, -15), ArrowDown: () => step(0, 15),
      "+": () => zoom(0.87), "=": () => zoom(0.87), "-": () => zoom(1.15), 0: reset,
    };
    if (!keys[event.key]) return;
    keys[event.key]();
    event.preventDefault();
    redraw();
  });
  figure.querySelector("[data-view]").addEventListener("click", () => { reset(); redraw(); });
  for (const button of figure.querySelectorAll("[data-mode]")) {
    button.addEventListener("click", () => {
      mode = button.dataset.mode;
      for (const other of figure.querySelectorAll("[data-mode]")) other.setAttribute("aria-pressed", String(other === button));
      drawLegend();
      redraw();
    });
  }
  canvas.addEventListener("webglcontextlost", () => stage.classList.remove("live"));
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  new ResizeObserver(redraw).observe(canvas);

  stage.classList.add("live");
  reset();
  draw();
})();
