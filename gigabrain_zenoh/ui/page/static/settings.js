// The table of settings: parameters of the running processes, to change one by one and to save in a file.
import { $, setText } from './panels.js'

export class Settings {
  #rows = new Map() // by process and name

  /** `request(what, more)` resolves to the robot's reply. */
  constructor(request) {
    this.request = request
    this.shown = [] // as the robot sent them
  }

  /** Request all settings; keep a value that a person is typing. */
  async refresh() {
    const reply = await this.request('settings')
    if (!reply.ok) return this.#showReply(reply)
    this.shown = reply.settings
    const known = new Set(this.shown.map(({ process, param }) => `${process} ${param.name}`))
    for (const [key, row] of this.#rows) {
      if (!known.has(key) && !row.contains(document.activeElement)) { row.remove(); this.#rows.delete(key) }
    }
    for (const setting of this.shown) this.#fill(setting)
    this.#offerFile()
  }

  #fill({ process, param }) {
    const key = `${process} ${param.name}`
    const row = this.#rows.get(key) ?? this.#add(key, process, param)
    const input = row.querySelector('input'), [, , initial, expected] = row.children
    if (document.activeElement !== input) input.value = param.value
    setText(initial, param.initial)
    setText(expected, param.expected)
    row.classList.toggle('changed', param.value !== param.initial)
  }

  #add(key, process, param) {
    const row = $('settings').querySelector('tbody').insertRow(), input = document.createElement('input')
    input.setAttribute('aria-label', `${param.name} of ${process}`)
    input.addEventListener('change', () => this.#set(process, param.name, input))
    row.insertCell().textContent = param.name
    row.insertCell().append(input)
    for (const text of ['', '', process]) row.insertCell().textContent = text
    this.#rows.set(key, row)
    return row
  }

  async #set(process, name, input) {
    const reply = await this.request('set', { process, name, value: input.value.trim() })
    this.#showReply(reply)
    input.blur()
    await this.refresh()
  }

  #showReply(reply) {
    setText($('setting-reply'), reply.text)
    $('setting-reply').className = `note${reply.ok ? '' : ' bad'}`
  }

  /** Offer the changed settings as a file; JSON is YAML. */
  #offerFile() {
    const file = {}
    for (const { param } of this.shown) {
      if (param.value === param.initial) continue
      const names = param.key.split('.'), last = names.pop()
      const section = names.reduce((at, name) => (at[name] ??= {}), file)
      try { section[last] = JSON.parse(param.value) } catch { section[last] = param.value }
    }
    $('save-settings').hidden = !Object.keys(file).length
    $('save-settings').href = `data:application/yaml,${encodeURIComponent(`${JSON.stringify(file, null, 2)}\n`)}`
  }
}
