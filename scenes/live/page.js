// Sends held keys, the gamepad and the sticks on a phone's screen to mapctl live, over a socket of its own. It runs before viser's script, so that keys
// that steer do not also move viser's camera.
(() => {
  const { keys, help } = document.currentScript.dataset;
  const KEYS = new Set(keys.split(" "));
  const POLL_MS = 40, AGAIN_MS = 1000;
  const held = new Set();
  let socket = null, sent = "";

  const touched = { move: null, aim: null, runs: false };  // sticks on the screen, -1 to 1 to the right and down

  const round = (value) => Math.round((value ?? 0) * 50) / 50;
  const readSticks = () => {
    const pad = [...(navigator.getGamepads?.() ?? [])].find((one) => one !== null && one.connected);
    const [x, y, right, down] = pad === undefined || document.hidden ? [] : pad.axes;
    const stick = touched.move !== null ? [...touched.move, touched.runs ? 1 : 0]
      : x === undefined ? null : [x, y, pad.buttons[7]?.value];
    const aim = touched.aim ?? (right === undefined ? null : [right, down]);
    return { stick: stick?.map(round) ?? null, aim: aim?.map(round) ?? null };
  };
  const send = () => {
    if (socket?.readyState !== WebSocket.OPEN) return;
    const viewer = document.querySelector("[data-mapctl-viewer]")?.dataset.mapctlViewer;
    const state = JSON.stringify({ keys: [...held], ...readSticks(), viewer: viewer ? Number(viewer) : null });
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
  const letGo = () => { held.clear(); touched.move = touched.aim = null; send(); };
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

  // Sticks and buttons for fingers. On a phone viser's panel begins folded to the bar at the bottom.
  const touch = document.createElement("div");
  touch.id = "mapctl-touch";
  const add = (tag, text, name) => {
    const element = Object.assign(document.createElement(tag), { textContent: text, id: `mapctl-${name}` });
    touch.append(element);
    return element;
  };
  const addStick = (name, text) => {
    const base = add("div", text, name), knob = base.appendChild(document.createElement("i"));
    const move = (event) => {
      const { left, top, width } = base.getBoundingClientRect(), half = width / 2;
      const at = event === null ? [0, 0] : [event.clientX - left - half, event.clientY - top - half];
      const far = Math.max(1, Math.hypot(...at) / half);
      knob.style.translate = at.map((value) => `${value / far}px`).join(" ");
      touched[name] = event === null ? null : at.map((value) => value / far / half);
      send();
    };
    base.addEventListener("pointerdown", (event) => { base.setPointerCapture?.(event.pointerId); move(event); });
    base.addEventListener("pointermove", (event) => { if (touched[name] !== null) move(event); });
    for (const end of ["pointerup", "pointercancel"]) base.addEventListener(end, () => move(null));
  };
  const press = (code) => { held.add(code); send(); held.delete(code); send(); };
  addStick("move", "walk");
  addStick("aim", "face");
  add("button", "Run", "run").onclick = ({ target }) => { target.ariaPressed = touched.runs = !touched.runs; send(); };
  add("button", "Stop", "stop").onclick = () => press("KeyX");
  add("button", "Lock", "lock").onclick = () => press("KeyL");
  const fold = setInterval(() => {
    const panel = document.querySelector("[data-mapctl-viewer]")?.closest("[style*='position: fixed']");
    const bar = panel?.querySelector("[style*='cursor: pointer']");
    if (bar || innerWidth > 576) clearInterval(fold);
    if (innerWidth <= 576) bar?.click();
  }, 200);

  const style = document.createElement("style");
  style.textContent = `
    #mapctl-help { position: fixed; left: 12px; bottom: 12px; z-index: 5; font: 12px/1.4 system-ui, sans-serif;
      color: #39424e; background: rgba(255, 255, 255, 0.82); border: 1px solid rgba(90, 100, 115, 0.25);
      border-radius: 6px; padding: 4px 10px; max-height: 70vh; max-width: min(330px, 46vw); overflow: auto; }
    #mapctl-help summary { cursor: pointer; user-select: none; }
    #mapctl-help td { padding: 1px 10px 1px 0; vertical-align: top; }
    #mapctl-help kbd { font: 11px ui-monospace, monospace; white-space: nowrap; padding: 0 4px; border-radius: 3px;
      border: 1px solid rgba(120, 130, 145, 0.45); }
    #mapctl-touch { display: none; }
    @media (pointer: coarse), (max-width: 576px) {
      #mapctl-help { display: none; }
      #mapctl-touch { display: contents; font: 13px system-ui, sans-serif; color: #39424e; }
      #mapctl-touch > * { position: fixed; z-index: 5; touch-action: none; user-select: none; color: inherit;
        background: rgba(255, 255, 255, 0.6); border: 1px solid rgba(90, 100, 115, 0.35); }
      #mapctl-touch > div { bottom: 68px; width: 116px; height: 116px; border-radius: 50%; text-align: center;
        line-height: 24px; }
      #mapctl-touch i { position: absolute; left: 35px; top: 35px; width: 44px; height: 44px; border-radius: 50%;
        background: rgba(38, 98, 184, 0.75); pointer-events: none; }
      #mapctl-move { left: 20px; }
      #mapctl-aim { right: 20px; }
      #mapctl-touch > button { left: calc(50% - 34px); width: 68px; height: 36px; border-radius: 10px; }
      #mapctl-touch > button[aria-pressed=true] { background: rgba(38, 98, 184, 0.75); color: white; }
      #mapctl-run { bottom: 148px; }
      #mapctl-stop { bottom: 108px; }
      #mapctl-lock { bottom: 68px; }
    }`;
  document.head.append(style);
  document.addEventListener("DOMContentLoaded", () => document.body.append(list, touch));
  connect();
})();
