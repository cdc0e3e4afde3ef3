// Releases held keys and buttons when a browser may not report their release.
const PERIOD_MS = 40
const MAX_STALL_MS = 1000

/** Call `release` when the window loses the focus or is hidden, and after the page was suspended, for example by a dialog. */
export function onLostRelease(release) {
  addEventListener('blur', release)
  document.addEventListener('visibilitychange', release)
  // macOS reports no keyup of a key that is released while Cmd is held
  addEventListener('keydown', (event) => { if (event.metaKey) release() }, true)
  let lastMs = performance.now()
  setInterval(() => {
    const nowMs = performance.now()
    if (nowMs - lastMs > MAX_STALL_MS) release()
    lastMs = nowMs
  }, PERIOD_MS)
}
