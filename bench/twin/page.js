// SPDX-License-Identifier: MIT
// Draws a twin with WebGL 2: observed points, surfaces that the sliders move, joint axes.
// Matrices are 4x4, column major, as WebGL takes them. All coordinates are the camera's, metres.
"use strict";
(function () {
  const data = JSON.parse(document.getElementById("data").textContent);
  const canvas = document.querySelector("canvas");
  const inputs = [...document.querySelectorAll("input[type=range]")];
  const shown = (id) => document.getElementById(id).checked;
  const state = data.joints.map((joint) => joint.state);

  function decoded(text, Kind) {
    return new Kind(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
  }

  // --- matrices -------------------------------------------------------------------------------
  function product(a, b) {
    const made = new Float32Array(16);
    for (let c = 0; c < 4; c++)
      for (let r = 0; r < 4; r++)
        for (let k = 0; k < 4; k++) made[4 * c + r] += a[4 * k + r] * b[4 * c + k];
    return made;
  }
  const identity = () => Float32Array.of(1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1);
  function shift(x, y, z) {
    const made = identity();
    made.set([x, y, z], 12);
    return made;
  }
  function turn(axis, angle) {
    const [x, y, z] = axis, c = Math.cos(angle), s = Math.sin(angle), k = 1 - c;
    return Float32Array.of(
      k * x * x + c, k * x * y + s * z, k * x * z - s * y, 0,
      k * x * y - s * z, k * y * y + c, k * y * z + s * x, 0,
      k * x * z + s * y, k * y * z - s * x, k * z * z + c, 0, 0, 0, 0, 1);
  }
  function motion(joint, by) {
    if (joint.kind === "prismatic") return shift(...joint.axis.map((a) => a * by));
    const [x, y, z] = joint.pivot;
    return product(shift(x, y, z), product(turn(joint.axis, by), shift(-x, -y, -z)));
  }
  function partMatrices() {
    const made = data.parts.map(identity);
    data.joints.forEach((joint, j) => {
      made[joint.child] = product(made[joint.parent], motion(joint, state[j] - joint.state));
    });
    return made;
  }

  // --- view -----------------------------------------------------------------------------------
  const home = { turned: identity(), away: Math.max(Math.hypot(...data.centre), 3 * data.radius) };
  let view = { ...home };
  const FLIP = Float32Array.of(1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1);
  function viewMatrix() {
    const [x, y, z] = data.centre;
    return product(shift(0, 0, -view.away), product(view.turned, product(data.look, product(FLIP, shift(-x, -y, -z)))));
  }
  function projection(aspect) {
    const near = view.away * 0.02, far = view.away + 20 * data.radius;
    // The whole object fits at the home distance, whatever the picture's shape.
    const sine = Math.min(data.radius / home.away, 0.9);
    const half = (1.1 * sine) / Math.sqrt(1 - sine * sine) / Math.min(1, aspect);
    return Float32Array.of(
      1 / (half * aspect), 0, 0, 0, 0, 1 / half, 0, 0,
      0, 0, -(far + near) / (far - near), -1, 0, 0, (-2 * far * near) / (far - near), 0);
  }
  function orbit(dx, dy) {
    view.turned = product(turn([1, 0, 0], dy), product(turn([0, 1, 0], dx), view.turned));
    draw();
  }
  function zoom(factor) {
    view.away = Math.min(Math.max(view.away * factor, 0.2 * home.away), 8 * home.away);
    draw();
  }

  // --- drawing --------------------------------------------------------------------------------
  const gl = canvas.getContext("webgl2", { antialias: true });
  if (!gl) document.getElementById("nothing").style.display = "block";
  const VERTEX = `#version 300 es
    uniform mat4 model, view, projection; uniform float size, nearer; in vec3 place; out vec3 seen;
    void main() { vec4 at = view * model * vec4(place, 1.0); seen = at.xyz;
      gl_Position = projection * at; gl_Position.z -= nearer * gl_Position.w; gl_PointSize = size; }`;
  const FRAGMENT = `#version 300 es
    precision highp float; uniform vec3 color; uniform float lit; in vec3 seen; out vec4 pixel;
    void main() { float light = 1.0;
      if (lit > 0.5) { vec3 normal = normalize(cross(dFdx(seen), dFdy(seen)));
        light = 0.35 + 0.65 * abs(dot(normal, normalize(vec3(0.3, 0.5, 1.0)))); }
      pixel = vec4(color * light, 1.0); }`;
  let program, at = {}, buffers = {};

  function compiled(kind, text) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    return shader;
  }
  function mesh(vertices, faces) {
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, vertices, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    if (faces) {
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
    }
    return { array, count: faces ? faces.length : vertices.length / 3, indexed: Boolean(faces) };
  }
  // A joint's axis: a thin prism along it, and an arrow head for the sense (right-hand rule).
  function arrow(joint) {
    const least = joint.axis.map(Math.abs), k = least.indexOf(Math.min(...least));
    const aside = [0, 1, 2].map((i) => (i === k ? 1 : 0) - joint.axis[i] * joint.axis[k]);
    const length = Math.hypot(...aside), u = aside.map((a) => a / length), n = joint.axis;
    const v = [n[1] * u[2] - n[2] * u[1], n[2] * u[0] - n[0] * u[2], n[0] * u[1] - n[1] * u[0]];
    const reach = joint.reach, thick = 0.009 * data.radius, sides = 10;
    const ring = (along, wide, i) => [0, 1, 2].map((c) => joint.pivot[c] + n[c] * along
      + wide * (u[c] * Math.cos((2 * Math.PI * i) / sides) + v[c] * Math.sin((2 * Math.PI * i) / sides)));
    const places = [], tip = reach + 0.16 * data.radius;
    for (let i = 0; i < sides; i++) {
      const [a, b, c, d] = [ring(-reach, thick, i), ring(-reach, thick, i + 1), ring(reach, thick, i), ring(reach, thick, i + 1)];
      places.push(...a, ...b, ...c, ...b, ...d, ...c);
      places.push(...ring(reach, 3.5 * thick, i), ...ring(reach, 3.5 * thick, i + 1), ...ring(tip, 0, 0));
    }
    return mesh(new Float32Array(places));
  }
  function prepare() {
    program = gl.createProgram();
    gl.attachShader(program, compiled(gl.VERTEX_SHADER, VERTEX));
    gl.attachShader(program, compiled(gl.FRAGMENT_SHADER, FRAGMENT));
    gl.bindAttribLocation(program, 0, "place");
    gl.linkProgram(program);
    gl.useProgram(program);
    for (const name of ["model", "view", "projection", "size", "nearer", "color", "lit"])
      at[name] = gl.getUniformLocation(program, name);
    buffers = {
      solid: data.parts.map((part) => part.vertices && mesh(decoded(part.vertices, Float32Array), decoded(part.faces, Uint32Array))),
      cloud: data.clouds.map((cloud) => mesh(decoded(cloud.points, Float32Array))),
      axes: data.joints.map(arrow),
    };
  }
  function put(what, kind, matrix, color, lit, size, nearer) {
    gl.uniformMatrix4fv(at.model, false, matrix);
    gl.uniform3fv(at.color, color);
    gl.uniform1f(at.lit, lit);
    gl.uniform1f(at.size, size);
    gl.uniform1f(at.nearer, nearer);
    gl.bindVertexArray(what.array);
    if (what.indexed) gl.drawElements(kind, what.count, gl.UNSIGNED_INT, 0);
    else gl.drawArrays(kind, 0, what.count);
  }
  function cssColor(name) {
    const text = getComputedStyle(document.documentElement).getPropertyValue(name).trim().slice(1);
    const wide = text.length === 3 ? [...text].map((c) => c + c).join("") : text;
    return [0, 2, 4].map((i) => parseInt(wide.slice(i, i + 2), 16) / 255);
  }
  let waiting = false;
  function draw() {
    if (!gl || waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; paint(); });
  }
  function paint() {
    const scale = window.devicePixelRatio || 1;
    const wide = Math.max(1, Math.round(canvas.clientWidth * scale)), high = Math.max(1, Math.round(canvas.clientHeight * scale));
    if (canvas.width !== wide || canvas.height !== high) { canvas.width = wide; canvas.height = high; }
    gl.viewport(0, 0, wide, high);
    gl.clearColor(...cssColor("--scene"), 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.uniformMatrix4fv(at.view, false, viewMatrix());
    gl.uniformMatrix4fv(at.projection, false, projection(wide / high));
    const moved = partMatrices(), tone = cssColor("--scene")[0] > 0.5 ? 0.72 : 1.15;
    if (shown("solid"))
      buffers.solid.forEach((what, p) => what && put(what, gl.TRIANGLES, moved[p], data.parts[p].color.map((c) => 0.62 * c + 0.38), 1, 1, 0));
    if (shown("cloud"))
      buffers.cloud.forEach((what, k) => put(what, gl.POINTS, identity(), data.clouds[k].color.map((c) => Math.min(1, tone * c)), 0, 3.5 * scale, 0.004));
    if (shown("axes")) {
      gl.disable(gl.DEPTH_TEST);
      buffers.axes.forEach((what, j) => put(what, gl.TRIANGLES, moved[data.joints[j].parent], cssColor("--axis"), 0, 1, 0));
    }
  }

  // --- controls -------------------------------------------------------------------------------
  function words(joint, value) {
    return joint.kind === "prismatic" ? `${(100 * value).toFixed(1)} cm` : `${((180 / Math.PI) * value).toFixed(1)}°`;
  }
  function follow(j, value) {
    state[j] = value;
    const text = words(data.joints[j], value);
    inputs[j].setAttribute("aria-valuetext", text);
    document.getElementById(`value-${j}`).textContent = text;
    draw();
  }
  inputs.forEach((input, j) => input.addEventListener("input", () => follow(j, Number(input.value))));
  document.getElementById("reset").addEventListener("click", () =>
    inputs.forEach((input, j) => { input.value = String(data.joints[j].state); follow(j, data.joints[j].state); }));
  for (const id of ["cloud", "solid", "axes"]) document.getElementById(id).addEventListener("change", draw);

  const pointers = new Map();
  const spread = () => { const [a, b] = [...pointers.values()]; return Math.hypot(a.x - b.x, a.y - b.y) || 1; };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const old = pointers.get(event.pointerId);
    if (!old) return;
    const before = pointers.size === 2 ? spread() : 0;
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (pointers.size === 2) zoom(before / spread());
    else if (pointers.size === 1) orbit((event.clientX - old.x) * 0.01, (event.clientY - old.y) * 0.01);
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(0.001 * event.deltaY)); }, { passive: false });
  const KEYS = {
    ArrowLeft: () => orbit(-0.1, 0), ArrowRight: () => orbit(0.1, 0), ArrowUp: () => orbit(0, -0.1), ArrowDown: () => orbit(0, 0.1),
    "+": () => zoom(0.9), "=": () => zoom(0.9), "-": () => zoom(1.1), 0: () => { view = { ...home }; draw(); },
  };
  canvas.addEventListener("keydown", (event) => {
    if (!KEYS[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    KEYS[event.key]();
  });
  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => { prepare(); draw(); });
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  new ResizeObserver(draw).observe(canvas);
  if (gl) prepare();
  data.joints.forEach((joint, j) => follow(j, joint.state));
})();
