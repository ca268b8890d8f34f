// The search of a site that is opened from the disk. Browsers start no worker from file://, so a hidden frame takes its
// place here. Material for MkDocs loads such a script from a CDN otherwise; this site asks the network for nothing.
if (location.protocol === 'file:') {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      const frame = document.createElement('iframe')
      frame.hidden = true
      document.body.append(frame)
      this.global = frame.contentWindow
      this.waiting = [] // what is posted before the script has run
      // what a worker finds in its global scope
      this.global.postMessage = (data) => setTimeout(() => this.deliver(this, data))
      this.global.importScripts = (...urls) =>
        urls.reduce((before, next) => before.then(() => this.load(next)), Promise.resolve())
      this.load(url).then(() => {
        const waiting = this.waiting
        this.waiting = null
        waiting.forEach((data) => this.postMessage(data))
      })
    }

    load(url) {
      return new Promise((resolve, reject) => {
        const script = this.global.document.createElement('script')
        script.src = new URL(url, location.href)
        script.onload = resolve
        script.onerror = () => reject(new Error(`${url} cannot be read`))
        this.global.document.body.append(script)
      })
    }

    deliver(target, data) {
      target.dispatchEvent(new target.global.MessageEvent('message', { data }))
    }

    postMessage(data) {
      if (this.waiting) this.waiting.push(data)
      else setTimeout(() => this.global.dispatchEvent(new this.global.MessageEvent('message', { data })))
    }

    terminate() {
      this.global.frameElement.remove()
    }
  }
}
