// Search from disk. A browser starts no worker for pages that are opened as files; the site's search is one. This takes
// its place there: the worker's script runs in a hidden frame, with the few functions that it uses of a worker.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.waiting = [];
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      document.body.appendChild(this.frame);
      const inner = this.frame.contentWindow;
      inner.postMessage = (message) => {
        const event = new MessageEvent("message", { data: message });
        this.dispatchEvent(event);
        if (this.onmessage) this.onmessage(event);
      };
      inner.importScripts = (...urls) => Promise.all(urls.map((name) => this.load(name)));
      this.load(url).then(() => {
        this.isReady = true;
        this.waiting.splice(0).forEach((message) => this.postMessage(message));
      });
    }

    load(url) {
      const page = this.frame.contentDocument, script = page.createElement("script");
      script.src = new URL(url, location.href).href;
      return new Promise((resolve, reject) => {
        script.onload = resolve;
        script.onerror = () => reject(new Error(`${url} is missing: build the site again`));
        page.body.appendChild(script);
      });
    }

    postMessage(message) {
      if (!this.isReady) {
        this.waiting.push(message);
        return;
      }
      this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data: message }));
    }

    terminate() {
      this.frame.remove();
    }
  };
}
