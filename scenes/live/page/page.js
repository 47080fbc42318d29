// Sends held keys, the gamepad and the page's layout to mapctl live, over a socket of its own. It runs before viser's
// script, so that keys that steer do not also move viser's camera.
(() => {
  const { token, keys: known } = document.currentScript.dataset;
  const KEYS = new Set(known.split(" "));
  const POLL_MS = 40, LAYOUT_MS = 400, AGAIN_MS = 1000;
  const held = new Set();
  let socket = null, pad = null, layout = "", help = null;

  const send = (message) => {
    if (socket !== null && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
  };
  const sendKeys = () => send({ keys: [...held] });

  const connect = () => {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    socket = new WebSocket(`${scheme}://${location.host}/mapctl/page?token=${token}`);
    socket.onopen = () => { layout = ""; sendKeys(); };
    socket.onmessage = (event) => showHelp(JSON.parse(event.data));
    socket.onclose = () => setTimeout(connect, AGAIN_MS);
  };

  const isTyping = (element) =>
    element instanceof HTMLElement && (element.isContentEditable || element.tagName === "TEXTAREA" ||
    (element.tagName === "INPUT" && !["checkbox", "radio", "button", "range"].includes(element.type)));
  const isSlider = (element) => element instanceof HTMLElement && element.getAttribute("role") === "slider";

  window.addEventListener("keydown", (event) => {
    const other = event.ctrlKey || event.metaKey || event.altKey;
    if (!KEYS.has(event.code) || other || isTyping(event.target)) return;
    if (isSlider(event.target) && event.code.startsWith("Arrow")) return;
    event.stopImmediatePropagation();
    if (!event.code.startsWith("Shift")) event.preventDefault();
    if (event.code === "KeyH" && !event.repeat && help !== null) help.open = !help.open;
    if (!event.repeat && !held.has(event.code)) { held.add(event.code); sendKeys(); }
  }, true);
  window.addEventListener("keyup", (event) => { if (held.delete(event.code)) sendKeys(); }, true);
  const letGo = () => { if (held.size > 0) { held.clear(); sendKeys(); } };
  window.addEventListener("blur", letGo);
  document.addEventListener("visibilitychange", () => { if (document.hidden) letGo(); });

  const round = (value) => Math.round(value * 50) / 50;
  const readPad = () => {
    const found = [...(navigator.getGamepads?.() ?? [])].find((one) => one !== null && one.connected);
    if (found === undefined) return null;
    const idle = document.hidden;
    return {
      axes: [...found.axes].slice(0, 4).map((value) => (idle ? 0 : round(value))),
      buttons: [...found.buttons].slice(0, 17).map((button) => (idle ? 0 : round(button.value))),
    };
  };
  setInterval(() => {
    const now = JSON.stringify(readPad());
    if (now !== (pad ?? "null")) send({ pad: JSON.parse(now) });
    pad = now;
  }, POLL_MS);

  const rectangle = (element) => {
    const box = element.getBoundingClientRect();
    return [box.left, box.top, box.width, box.height].map(Math.round);
  };
  const largest = (elements) =>
    [...elements].sort((a, b) => b.clientWidth * b.clientHeight - a.clientWidth * a.clientHeight)[0];
  const readLayout = () => {
    const canvas = largest(document.querySelectorAll("canvas"));
    const panel = largest(document.querySelectorAll("[data-floating-window]"));
    const viewer = document.querySelector("[data-mapctl-viewer]");
    if (canvas === undefined) return null;
    if (help !== null) {
      const [left, , , ] = rectangle(canvas);
      help.style.left = `${left + 12}px`;
    }
    return {
      canvas: rectangle(canvas),
      panel: panel === undefined ? null : rectangle(panel),
      viewer: viewer === null ? null : Number(viewer.dataset.mapctlViewer),
      dark: window.matchMedia("(prefers-color-scheme: dark)").matches,
    };
  };
  setInterval(() => {
    const now = readLayout();
    if (now !== null && JSON.stringify(now) !== layout && socket?.readyState === WebSocket.OPEN) {
      layout = JSON.stringify(now);
      send({ layout: now });
    }
  }, LAYOUT_MS);

  // The list of keys, in the lower left corner of the picture.
  const showHelp = ({ help: rows, dark }) => {
    if (help === null) {
      help = document.createElement("details");
      help.id = "mapctl-help";
      document.body.append(help);
    }
    help.className = dark ? "dark" : "";
    const summary = document.createElement("summary");
    summary.textContent = "Keys (H)";
    const table = document.createElement("table");
    for (const [key, does] of rows) {
      const row = table.insertRow();
      const mark = document.createElement("kbd");
      mark.textContent = key;
      row.insertCell().append(mark);
      row.insertCell().textContent = does;
    }
    help.replaceChildren(summary, table);
  };
  const style = document.createElement("style");
  style.textContent = `
    #mapctl-help { position: fixed; left: 12px; bottom: 12px; z-index: 5; font: 12px/1.4 system-ui, sans-serif;
      color: #39424e; background: rgba(255, 255, 255, 0.82); border: 1px solid rgba(90, 100, 115, 0.25);
      border-radius: 6px; padding: 4px 10px; backdrop-filter: blur(4px); max-height: 70vh;
      max-width: min(330px, 46vw); overflow: auto; }
    #mapctl-help.dark { color: #cdd5df; background: rgba(24, 29, 37, 0.82); border-color: rgba(150, 165, 185, 0.25); }
    #mapctl-help summary { cursor: pointer; user-select: none; }
    #mapctl-help td { padding: 1px 10px 1px 0; vertical-align: top; }
    #mapctl-help kbd { font: 11px ui-monospace, monospace; white-space: nowrap; padding: 0 4px; border-radius: 3px;
      border: 1px solid rgba(120, 130, 145, 0.45); }`;
  document.head.append(style);
  connect();
})();
