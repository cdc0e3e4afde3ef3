// Draws the shapes of a simulated world with WebGL: one buffer of triangles for each body.
const TAU = 2 * Math.PI
const [PLANE, BOX, CYLINDER, SPHERE, CAPSULE, ELLIPSOID, MESH] = [0, 1, 2, 3, 4, 5, 6]
const SIDES = 20, RINGS = 8 // of round shapes
const FLOOR_M = 60 // half the drawn side of an endless floor
const FLOATS = 7 // of a vertex: position, normal, and all of its colour in one
const SOLID = 126 // alpha of all but the floor; with a higher one a colour could be NaN

const VERTEX = `
attribute vec3 position, normal; attribute vec4 colour;
uniform mat4 view, body; varying vec3 vNormal, vPlace; varying vec4 vColour;
void main() {
  vec4 place = body * vec4(position, 1.0);
  vPlace = place.xyz; vNormal = mat3(body[0].xyz, body[1].xyz, body[2].xyz) * normal; vColour = colour;
  gl_Position = view * place;
}`
const FRAGMENT = `
precision mediump float;
varying vec3 vNormal, vPlace; varying vec4 vColour; uniform vec3 sky;
void main() {
  vec3 n = normalize(vNormal);
  float light = 0.55 + 0.15 * n.z + 0.3 * max(0.0, dot(n, normalize(vec3(-0.35, -0.5, 0.8))));
  vec3 colour = vColour.rgb;
  if (vColour.a < 0.25) { // the floor has checks, and fades into the background
    vec2 cell = floor(vPlace.xy * 2.0);
    colour *= mod(cell.x + cell.y, 2.0) < 0.5 ? 1.0 : 0.93;
    gl_FragColor = vec4(mix(colour * light, sky, smoothstep(12.0, 45.0, length(vPlace.xy))), 1.0);
  } else gl_FragColor = vec4(colour * light, 1.0);
}`

/** Return the columns of the rotation of a quaternion w, x, y, z. */
function rotation([w, x, y, z]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
    [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
    [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
  ]
}

/** Return the matrix of a pose x, y, z, w, x, y, z, by column. */
export function matrixOf(pose) {
  const [a, b, c] = rotation(pose.slice(3))
  return new Float32Array([...a, 0, ...b, 0, ...c, 0, pose[0], pose[1], pose[2], 1])
}

/** Return a product of two matrices by column. */
function product(a, b) {
  const result = new Float32Array(16)
  for (let column = 0; column < 4; column++) for (let row = 0; row < 4; row++) {
    for (let k = 0; k < 4; k++) result[4 * column + row] += a[4 * k + row] * b[4 * column + k]
  }
  return result
}

const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
const unit = (a) => { const length = Math.hypot(...a) || 1; return [a[0] / length, a[1] / length, a[2] / length] }

/** A camera that looks at a place from an angle. */
export class Camera {
  target = [0, 0, 0]
  distance = 6
  azimuth = -2.2 // [rad], from the target to the camera
  elevation = 0.95

  get eye() {
    const flat = this.distance * Math.cos(this.elevation)
    return [
      this.target[0] + flat * Math.cos(this.azimuth), this.target[1] + flat * Math.sin(this.azimuth),
      this.target[2] + this.distance * Math.sin(this.elevation),
    ]
  }

  get axes() {
    const back = unit(minus(this.eye, this.target)), right = unit(cross([0, 0, 1], back))
    return { back, right, up: cross(back, right) }
  }

  /** Return the matrix from the world to the picture. */
  matrix(aspect) {
    const { back, right, up } = this.axes, eye = this.eye, near = 0.05, far = 200, f = 1.6
    const view = new Float32Array([
      right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0,
      -dot(right, eye), -dot(up, eye), -dot(back, eye), 1,
    ])
    const lens = new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, (2 * far * near) / (near - far), 0])
    return product(lens, view)
  }

  /** Return the direction of the ray through a point of the picture, each from -1 to 1. */
  ray(x, y, aspect) {
    const { back, right, up } = this.axes
    return unit([0, 1, 2].map((i) => (x * aspect / 1.6) * right[i] + (y / 1.6) * up[i] - back[i]))
  }
}

/** Return the four bytes of a colour as a float; alpha 0 stands for the floor. */
function packed([r, g, b], alpha = SOLID) {
  return new Float32Array(new Uint8Array([r, g, b, alpha]).buffer)[0]
}

/** Collects the triangles of one body. */
class Triangles {
  constructor() { this.values = [] }

  /** Add the points and normals of a shape, moved to its place. */
  add(points, normals, place, colour) {
    const [a, b, c] = rotation(place.slice(3))
    const turn = (p) => [0, 1, 2].map((i) => a[i] * p[0] + b[i] * p[1] + c[i] * p[2])
    for (let i = 0; i < points.length; i++) {
      const p = turn(points[i]), n = turn(normals[i])
      this.values.push(p[0] + place[0], p[1] + place[1], p[2] + place[2], n[0], n[1], n[2], colour)
    }
  }
}

/** Return points and normals of a grid of four-cornered patches, by functions of u and v. */
function patches(across, along, point, normal) {
  const points = [], normals = []
  for (let i = 0; i < across; i++) for (let j = 0; j < along; j++) {
    for (const [di, dj] of [[0, 0], [1, 0], [1, 1], [0, 0], [1, 1], [0, 1]]) {
      points.push(point((i + di) / across, (j + dj) / along))
      normals.push(normal((i + di) / across, (j + dj) / along))
    }
  }
  return [points, normals]
}

function box([x, y, z]) {
  const points = [], normals = []
  for (let axis = 0; axis < 3; axis++) for (const side of [-1, 1]) {
    for (const [u, v] of [[-1, -1], [1, -1], [1, 1], [-1, -1], [1, 1], [-1, 1]]) {
      const p = [0, 0, 0], n = [0, 0, 0]
      p[axis] = n[axis] = side
      p[(axis + 1) % 3] = u
      p[(axis + 2) % 3] = v
      points.push([p[0] * x, p[1] * y, p[2] * z])
      normals.push(n)
    }
  }
  return [points, normals]
}

function round(radii, lift = () => 0) {
  const on = (u, v) => {
    const latitude = Math.PI * (v - 0.5)
    return [Math.cos(latitude) * Math.cos(TAU * u), Math.cos(latitude) * Math.sin(TAU * u), Math.sin(latitude)]
  }
  return patches(SIDES, 2 * RINGS,
    (u, v) => { const p = on(u, v); return [p[0] * radii[0], p[1] * radii[1], p[2] * radii[2] + lift(v)] },
    (u, v) => { const p = on(u, v); return unit([p[0] / radii[0], p[1] / radii[1], p[2] / radii[2]]) })
}

function cylinder(radius, half, capped) {
  const side = (u) => [Math.cos(TAU * u), Math.sin(TAU * u), 0]
  const [points, normals] = patches(SIDES, 1, (u, v) => { const p = side(u); return [radius * p[0], radius * p[1], half * (2 * v - 1)] }, side)
  for (const end of capped ? [-1, 1] : []) {
    const cap = patches(SIDES, 1, (u, v) => { const p = side(u); return [radius * v * p[0], radius * v * p[1], end * half] }, () => [0, 0, end])
    points.push(...cap[0])
    normals.push(...cap[1])
  }
  return [points, normals]
}

function mesh({ vertices, faces }) {
  const points = [], normals = []
  const vertex = (i) => [vertices[3 * i], vertices[3 * i + 1], vertices[3 * i + 2]]
  for (let i = 0; i + 2 < faces.length; i += 3) {
    const corners = [vertex(faces[i]), vertex(faces[i + 1]), vertex(faces[i + 2])]
    const normal = unit(cross(minus(corners[1], corners[0]), minus(corners[2], corners[0])))
    points.push(...corners)
    normals.push(normal, normal, normal)
  }
  return [points, normals]
}

/** Return points and normals of one shape of a scene. */
function shape(kind, size, meshes) {
  const [x, y, z] = size
  if (kind === PLANE) return [[[-1, -1], [1, -1], [1, 1], [-1, -1], [1, 1], [-1, 1]].map(([u, v]) => [u * (x || FLOOR_M), v * (y || FLOOR_M), 0]), Array(6).fill([0, 0, 1])]
  if (kind === BOX) return box(size)
  if (kind === CYLINDER) return cylinder(x, y, true)
  if (kind === SPHERE) return round([x, x, x])
  if (kind === ELLIPSOID) return round([x, y, z])
  if (kind === CAPSULE) return round([x, x, x], (v) => (v < 0.5 ? -y : y))
  return kind === MESH ? mesh(meshes[x]) : [[], []]
}

export class Renderer {
  #bodies = [] // the buffer and the number of vertices of each
  #marks = null // the same for boxes that are drawn in the frame of a body

  /** Throws an error if the browser has no WebGL. */
  constructor(canvas) {
    const gl = canvas.getContext('webgl', { antialias: true })
    if (!gl) throw new Error('this browser has no WebGL')
    this.gl = gl
    const program = gl.createProgram()
    for (const [type, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(type)
      gl.shaderSource(shader, source)
      gl.compileShader(shader)
      gl.attachShader(program, shader)
    }
    gl.linkProgram(program)
    gl.useProgram(program)
    gl.enable(gl.DEPTH_TEST)
    this.at = Object.fromEntries(['position', 'normal', 'colour'].map((name) => [name, gl.getAttribLocation(program, name)]))
    this.uniform = Object.fromEntries(['view', 'body', 'sky'].map((name) => [name, gl.getUniformLocation(program, name)]))
    for (const place of Object.values(this.at)) gl.enableVertexAttribArray(place)
  }

  /** Load the shapes of a scene. */
  load({ bodies, kinds, owners, sizes, places, colours, meshes }) {
    const gl = this.gl, parts = bodies.map(() => new Triangles())
    kinds.forEach((kind, i) => {
      const [points, normals] = shape(kind, sizes.subarray(3 * i, 3 * i + 3), meshes)
      const colour = packed(colours.subarray(4 * i, 4 * i + 3), kind === PLANE ? 0 : SOLID)
      parts[owners[i]].add(points, normals, [...places.subarray(7 * i, 7 * i + 7)], colour)
    })
    for (const { buffer } of this.#bodies) gl.deleteBuffer(buffer)
    this.#bodies = parts.map((part) => this.#stored(part))
  }

  /** Set the boxes to draw in the frame of a body, each with half its size, its pose, and its colour (0 to 255). */
  mark(boxes) {
    const triangles = new Triangles()
    for (const { size, pose, colour } of boxes) triangles.add(...box(size), pose, packed(colour))
    if (this.#marks) this.gl.deleteBuffer(this.#marks.buffer)
    this.#marks = this.#stored(triangles)
  }

  #stored({ values }) {
    const gl = this.gl, buffer = gl.createBuffer()
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer)
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(values), gl.STATIC_DRAW)
    return { buffer, count: values.length / FLOATS }
  }

  /** Draw all bodies with their `matrices`, and the marks in the frame of body number `marked`. */
  draw(camera, matrices, background, marked) {
    const gl = this.gl, { width, height } = gl.canvas
    gl.viewport(0, 0, width, height)
    gl.clearColor(...background, 1)
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT)
    gl.uniformMatrix4fv(this.uniform.view, false, camera.matrix(width / height))
    gl.uniform3fv(this.uniform.sky, background)
    const marks = this.#marks ? [[this.#marks, matrices[marked]]] : []
    for (const [{ buffer, count }, matrix] of [...this.#bodies.map((body, i) => [body, matrices[i]]), ...marks]) {
      if (!count || !matrix) continue
      gl.uniformMatrix4fv(this.uniform.body, false, matrix)
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer)
      gl.vertexAttribPointer(this.at.position, 3, gl.FLOAT, false, 4 * FLOATS, 0)
      gl.vertexAttribPointer(this.at.normal, 3, gl.FLOAT, false, 4 * FLOATS, 12)
      gl.vertexAttribPointer(this.at.colour, 4, gl.UNSIGNED_BYTE, true, 4 * FLOATS, 24)
      gl.drawArrays(gl.TRIANGLES, 0, count)
    }
  }
}
