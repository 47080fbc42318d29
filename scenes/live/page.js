// Sends held keys and the gamepad to mapctl live, over a socket of its own. It runs before viser's script, so that keys
// that steer do not also move viser's camera.
(() => {
  const { keys, help } = document.currentScript.dataset;
  const KEYS = new Set(keys.split(" "));
  const POLL_MS = 40, AGAIN_MS = 1000;
  const held = new Set();
  let socket = null, sent = "";

  const round = (value) => Math.round(value * 50) / 50;
  const readStick = () => {
    const pad = [...(navigator.getGamepads?.() ?? [])].find((one) => one !== null && one.connected);
    if (pad === undefined || document.hidden) return null;
    return [pad.axes[0], pad.axes[1], pad.buttons[7]?.value].map((value) => round(value ?? 0));
  };
  const send = () => {
    if (socket?.readyState !== WebSocket.OPEN) return;
    const viewer = document.querySelector("[data-mapctl-viewer]")?.dataset.mapctlViewer;
    const state = JSON.stringify({ keys: [...held], stick: readStick(), viewer: viewer ? Number(viewer) : null });
    if (state !== sent) socket.send(sent = state);
  };
  const connect = () => {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    socket = new WebSocket(`${scheme}://${location.host}/mapctl/page`);
    socket.onopen = () => { sent = ""; send(); };
    socket.onclose = () => setTimeout(connect, AGAIN_MS);
  };
  setInterval(send, POLL_MS);

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
    if (event.code === "KeyH" && !event.repeat) list.open = !list.open;
    held.add(event.code);
    send();
  }, true);
  window.addEventListener("keyup", (event) => { if (held.delete(event.code)) send(); }, true);
  const letGo = () => { held.clear(); send(); };
  window.addEventListener("blur", letGo);
  document.addEventListener("visibilitychange", () => { if (document.hidden) letGo(); });

  // The list of keys, in the lower left corner of the picture.
  const list = document.createElement("details");
  list.id = "mapctl-help";
  list.append(Object.assign(document.createElement("summary"), { textContent: "Keys (H)" }));
  const table = document.createElement("table");
  for (const [key, does] of JSON.parse(help)) {
    const row = table.insertRow();
    row.insertCell().append(Object.assign(document.createElement("kbd"), { textContent: key }));
    row.insertCell().textContent = does;
  }
  list.append(table);
  const style = document.createElement("style");
  style.textContent = `
    #mapctl-help { position: fixed; left: 12px; bottom: 12px; z-index: 5; font: 12px/1.4 system-ui, sans-serif;
      color: #39424e; background: rgba(255, 255, 255, 0.82); border: 1px solid rgba(90, 100, 115, 0.25);
      border-radius: 6px; padding: 4px 10px; max-height: 70vh; max-width: min(330px, 46vw); overflow: auto; }
    #mapctl-help summary { cursor: pointer; user-select: none; }
    #mapctl-help td { padding: 1px 10px 1px 0; vertical-align: top; }
    #mapctl-help kbd { font: 11px ui-monospace, monospace; white-space: nowrap; padding: 0 4px; border-radius: 3px;
      border: 1px solid rgba(120, 130, 145, 0.45); }`;
  document.head.append(style);
  document.addEventListener("DOMContentLoaded", () => document.body.append(list));
  connect();
})();
