// Pictures of the cameras, with what was recognised drawn over them. Pictures are sent only while the panel is open.
import { $, makeElement, setText } from './panels.js'

const SILENT_AFTER_MS = 1500, FOUND_SHOWN_MS = 1000
const MAX_CAMERAS = 16 // the limit of the server
const ARIA_INTERVAL_MS = 2000 // between two descriptions for screen readers
const LINE_PX = 2, TEXT_PX = 12 // on the screen
const CHANNELS = { rgb8: [0, 1, 2], bgr8: [2, 1, 0], mono8: [0, 0, 0] }
const distance = ([x, y]) => `${Math.hypot(x, y).toFixed(1)} m`

export class Cameras {
  #views = new Map() // by camera
  #open = false
  #boxes = true

  /** `watch(wanted)` requests pictures; `shown(camera)` reports that the last one is drawn. */
  constructor({ watch, shown }) {
    Object.assign(this, { watch, shown })
    $('show-cameras').addEventListener('click', () => this.open(!this.#open))
    $('show-boxes').addEventListener('click', () => {
      this.#boxes = !this.#boxes
      $('show-boxes').setAttribute('aria-pressed', this.#boxes)
      for (const view of this.#views.values()) this.#drawFound(view)
    })
    document.addEventListener('visibilitychange', () => this.resume())
    setInterval(() => this.#checkSilence(), 500)
  }

  open(open) {
    this.#open = open
    $('pictures').hidden = !open
    $('show-cameras').setAttribute('aria-pressed', open)
    for (const view of this.#views.values()) view.openedMs = performance.now()
    this.resume()
  }

  /** Request the wanted pictures again, for example after a new connection. */
  resume() {
    const folded = [...this.#views].filter(([, view]) => view.folded).map(([name]) => name)
    this.watch({ open: this.#open && !document.hidden && this.#views.size > 0, folded })
  }

  /** Add a panel for each new camera: those of the body, and others that publish pictures. */
  add(names) {
    const before = this.#views.size
    for (const name of names) this.#viewOf(name)
    if (this.#views.size > before) this.resume()
    $('show-cameras').hidden = this.#views.size === 0
  }

  setProblem({ camera, problem }) {
    this.add([camera])
    const view = this.#viewOf(camera)
    if (!view) return
    view.reported = problem
    this.#showProblem(view)
  }

  /** Show the problems that perception reports. */
  setStatus(cameras) {
    for (const { name, ok, problem } of cameras) {
      this.add([name])
      const view = this.#viewOf(name), blind = ok ? '' : problem || 'not plausible'
      if (!view || view.blind === blind) continue
      view.blind = blind
      this.#showProblem(view)
    }
  }

  /** Draw a picture: width, height, camera (64 bytes), encoding (16), data. */
  async image(data) {
    const head = new DataView(data, 4, 88), text = new TextDecoder()
    const [width, height] = [head.getUint32(0, true), head.getUint32(4, true)]
    const textAt = (at, length) => text.decode(new Uint8Array(data, 4 + at, length)).replace(/\0+$/, '')
    const camera = textAt(8, 64), encoding = textAt(72, 16), pixels = new Uint8Array(data, 92)
    const view = this.#viewOf(camera)
    if (!view) return
    try {
      const picture = encoding === 'jpeg' ? await createImageBitmap(new Blob([pixels], { type: 'image/jpeg' })) : fromPixels(pixels, width, height, encoding)
      drawPicture(view.picture, picture)
      view.broken = ''
      view.pictureMs = performance.now()
    } catch {
      view.broken = 'a broken picture'
    } finally {
      this.shown(camera)
    }
    this.#showProblem(view)
  }

  found(found) {
    const view = this.#viewOf(found.camera)
    if (!view) return
    Object.assign(view, { found, foundMs: performance.now() })
    this.#drawFound(view)
  }

  /** Return the panel of a camera, which may be new; undefined if there are too many. */
  #viewOf(camera) {
    if (!this.#views.has(camera) && this.#views.size < MAX_CAMERAS) this.#views.set(camera, this.#makeView(camera))
    return this.#views.get(camera)
  }

  #makeView(camera) {
    const figure = makeElement('figure'), caption = makeElement('figcaption')
    const fold = makeElement('button', camera), large = makeElement('button', '', 'frame')
    const picture = makeElement('canvas'), overlay = makeElement('canvas', '', 'overlay'), problem = makeElement('p', '', 'problem')
    figure.dataset.camera = camera
    picture.setAttribute('aria-hidden', 'true')
    overlay.setAttribute('aria-hidden', 'true')
    problem.setAttribute('role', 'status')
    large.append(picture, overlay)
    large.title = 'larger or smaller'
    caption.append(fold)
    figure.append(caption, large, problem)
    const view = { camera, figure, fold, large, picture, overlay, problem, folded: false, openedMs: performance.now(), pictureMs: 0, foundMs: 0, ariaMs: -ARIA_INTERVAL_MS, reported: '', blind: '', broken: '' }
    fold.addEventListener('click', () => { view.folded = !view.folded; this.#layOut(view); this.resume() })
    large.addEventListener('click', () => { figure.classList.toggle('large'); this.#layOut(view) })
    this.#layOut(view)
    const after = [...$('pictures').querySelectorAll('figure')].find((other) => other.dataset.camera > camera)
    $('pictures').insertBefore(figure, after ?? null)
    return view
  }

  #layOut(view) {
    view.fold.setAttribute('aria-expanded', !view.folded)
    view.large.hidden = view.folded
    view.large.setAttribute('aria-pressed', view.figure.classList.contains('large'))
    view.large.setAttribute('aria-label', `Picture of camera ${view.camera}`)
  }

  #drawFound(view) {
    const { overlay, found } = view, current = this.#boxes && found && performance.now() - view.foundMs < FOUND_SHOWN_MS
    const ratio = devicePixelRatio || 1, { clientWidth: width, clientHeight: height } = overlay
    overlay.width = Math.max(1, width * ratio)
    overlay.height = Math.max(1, height * ratio)
    if (!current) return
    const pen = overlay.getContext('2d'), scale = Math.max(width, 1) / found.width, size = TEXT_PX / scale
    pen.scale(ratio * scale, (ratio * Math.max(height, 1)) / found.height)
    pen.lineWidth = LINE_PX / scale
    pen.font = `600 ${size}px system-ui, sans-serif`
    for (const { label, confidence, box: [left, top, right, bottom], position } of found.things) {
      const text = `${label} ${Math.round(100 * confidence)} %${position ? ` · ${distance(position)}` : ''}`
      drawMark(pen, [[left, top], [right, top], [right, bottom], [left, bottom]], text, '#ffc107', size)
    }
    for (const { id, corners, position } of found.tags) drawMark(pen, corners, `tag ${id} · ${distance(position)}`, '#33d9f2', size)
    this.#describe(view)
  }

  #describe(view) {
    if (performance.now() - view.ariaMs < ARIA_INTERVAL_MS) return
    view.ariaMs = performance.now()
    const names = [...view.found.things.map(({ label }) => label), ...view.found.tags.map(({ id }) => `tag ${id}`)]
    view.large.setAttribute('aria-label', `Picture of camera ${view.camera}: ${names.join(', ') || 'nothing recognised'}`)
  }

  #checkSilence() {
    if (!this.#open || document.hidden) return
    for (const view of this.#views.values()) {
      this.#showProblem(view)
      if (view.found && performance.now() - view.foundMs > FOUND_SHOWN_MS) { view.found = null; this.#drawFound(view) }
    }
  }

  #showProblem(view) {
    const sinceMs = performance.now() - Math.max(view.pictureMs, view.openedMs)
    const silent = sinceMs > SILENT_AFTER_MS ? `no picture for ${(sinceMs / 1000).toFixed(0)} s` : ''
    const text = view.reported || view.blind || view.broken || (view.folded ? '' : silent)
    setText(view.problem, text)
    view.problem.hidden = !text
    view.figure.classList.toggle('blind', text !== '')
  }
}

function fromPixels(pixels, width, height, encoding) {
  const order = CHANNELS[encoding], step = encoding === 'mono8' ? 1 : 3
  if (!order) throw new Error(encoding)
  const image = new ImageData(width, height)
  for (let i = 0; i < width * height; i++) {
    order.forEach((from, to) => { image.data[4 * i + to] = pixels[step * i + from] })
    image.data[4 * i + 3] = 255
  }
  return image
}

function drawPicture(canvas, picture) {
  if (canvas.width !== picture.width || canvas.height !== picture.height) {
    canvas.width = picture.width
    canvas.height = picture.height
  }
  const pen = canvas.getContext('2d')
  if (picture instanceof ImageData) pen.putImageData(picture, 0, 0)
  else { pen.drawImage(picture, 0, 0); picture.close() }
}

function drawMark(pen, corners, text, colour, size) {
  pen.strokeStyle = colour
  pen.beginPath()
  corners.forEach(([u, v], i) => (i ? pen.lineTo(u, v) : pen.moveTo(u, v)))
  pen.closePath()
  pen.stroke()
  const left = Math.max(0, Math.min(...corners.map(([u]) => u))), top = Math.max(size + 2, Math.min(...corners.map(([, v]) => v)))
  pen.fillStyle = 'rgba(0, 0, 0, .65)'
  pen.fillRect(left, top - size - 2, pen.measureText(text).width + 4, size + 3)
  pen.fillStyle = colour
  pen.fillText(text, left + 2, top - 2)
}
