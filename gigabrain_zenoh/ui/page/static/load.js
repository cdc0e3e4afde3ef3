// Reloads the page if one of its files did not arrive: without that file, the page does not work.
const RELOAD_AFTER_MS = 1000
let reloads = false

addEventListener('error', (event) => {
  if (reloads || !event.target.matches?.('script, link[rel=stylesheet]')) return
  reloads = true
  const doing = document.getElementById('doing')
  if (doing) doing.textContent = 'a part of this page did not arrive; loading it again'
  setTimeout(() => location.reload(), RELOAD_AFTER_MS)
}, true)
