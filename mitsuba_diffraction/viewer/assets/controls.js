// The panel, the mouse, touch and the keyboard.

const $ = (id) => document.getElementById(id);
const CHOICES = ["shape", "scales", "material", "pigment", "right"];
const SWITCHES = ["hasBase", "difference"];

const NUMBERS = {
  lightWidth: (x) => `${x}°`,
  lightLength: (x) => (x === 0 ? "disc" : `${x}°`),
  sky: (x) => `${Math.round(100 * x)} %`,
  exposure: (x) => `${x > 0 ? "+" : ""}${x} EV`,
  orientation: (x) => `${x}°`,
  heightScale: (x) => `× ${x.toFixed(2)}`,
  coherenceLength: (x) => `${x.toPrecision(3)} µm`,
  index: (x) => x.toFixed(2),
  coat: (x) => (x === 1 ? "none" : x.toFixed(2)),
  terms: (x) => String(x),
  brightness: (x) => x.toPrecision(3),
};

const LOGARITHMIC = ["coherenceLength", "brightness"];

class Controls {
  constructor(state, changed, actions) {
    Object.assign(this, { state, changed, actions });
    for (const name of Object.keys(NUMBERS)) {
      $(name).addEventListener("input", () => this.set({ [name]: this.valueOf(name) }));
    }
    for (const name of CHOICES) $(name).addEventListener("input", () => this.set({ [name]: $(name).value }));
    for (const name of SWITCHES) $(name).addEventListener("input", () => this.set({ [name]: $(name).checked }));
    for (const [name, on] of [["published", true], ["corrected", false]]) {
      $(name).addEventListener("click", () => {
        const terms = on ? PUBLISHED_TERMS[this.state.right] : this.state.terms;
        this.set({ quirks: allQuirks(on), terms });
      });
    }
    for (const [name, [text]] of Object.entries(QUIRKS)) {
      const box = Object.assign(document.createElement("input"), { type: "checkbox", id: `quirk-${name}` });
      const label = document.createElement("label");
      label.append(box, ` ${text}`);
      $("quirks").append(label);
      box.addEventListener("input", () => this.set({ quirks: { ...this.state.quirks, [name]: box.checked } }));
    }
    this.followDivider($("divider"));
    $("lamp").addEventListener("pointerdown", (event) => $("lamp").setPointerCapture(event.pointerId));
    $("lamp").addEventListener("pointermove", (event) => {
      if (event.buttons) this.moveLight(0.4 * event.movementX, 0.4 * event.movementY);
    });
    $("lamp").addEventListener("keydown", (event) => this.key(event, true));
    $("close").addEventListener("click", () => { $("picked").hidden = true; });
    for (const [name, action] of Object.entries(actions)) $(name).addEventListener("click", action);
    this.followPointers($("canvas"));
    $("canvas").addEventListener("keydown", (event) => this.key(event));
    this.show();
  }

  valueOf(name) {
    const value = Number($(name).value);
    return LOGARITHMIC.includes(name) ? Math.exp(value) : value;
  }

  set(changes) {
    Object.assign(this.state, changes);
    this.show();
    this.changed();
  }

  show() {
    const { state } = this;
    for (const [name, text] of Object.entries(NUMBERS)) {
      $(name).value = LOGARITHMIC.includes(name) ? Math.log(state[name]) : state[name];
      $(`${name}-shown`).textContent = text(state[name]);
    }
    for (const name of CHOICES) $(name).value = state[name];
    for (const name of SWITCHES) $(name).checked = state[name];
    const compares = state.right !== "none";
    const isShader = state.right in VARIANTS;
    $("difference").disabled = !compares;
    $("of-shader").hidden = !isShader;
    $("terms").disabled = state.right === "gem";
    $("brightness").disabled = state.right !== "gem" && !state.quirks.relative;
    for (const [name, [, variants]] of Object.entries(QUIRKS)) {
      $(`quirk-${name}`).checked = state.quirks[name];
      $(`quirk-${name}`).parentElement.hidden = !variants.includes(state.right);
    }
    const split = compares && !state.difference;
    for (const name of ["divider", "left-name", "right-name"]) $(name).hidden = !split;
    $("legend").hidden = !(compares && state.difference);
    $("right-name").textContent = isShader ? `${state.right.toUpperCase().replace("_", " with ")}, 2014` : "reference";
    $("divider").style.left = `${100 * state.divider}%`;
    $("divider").setAttribute("aria-valuenow", Math.round(100 * state.divider));
    $("of-coil").hidden = state.shape !== "coil";
    const dielectric = state.material === "dielectric";
    for (const name of ["index", "hasBase", "pigment"]) $(name).disabled = !dielectric;
    $("pigment").disabled = !(dielectric && state.hasBase);
  }

  orbit(dx, dy) {
    const elevation = this.state.elevation + dy;
    this.set({
      azimuth: this.state.azimuth - dx,
      elevation: Math.min(Math.max(elevation, -FURTHEST_ELEVATION), FURTHEST_ELEVATION),
    });
  }

  moveLight(dx, dy) {
    const elevation = this.state.lightElevation - dy;
    this.set({
      lightAzimuth: this.state.lightAzimuth + dx,
      lightElevation: Math.min(Math.max(elevation, -FURTHEST_ELEVATION), FURTHEST_ELEVATION),
    });
  }

  zoom(factor) {
    this.set({ distance: Math.min(Math.max(this.state.distance * factor, 2), 20) });
  }

  followDivider(divider) {
    const move = (x) => this.set({ divider: Math.min(Math.max(x, 0), 1) });
    divider.addEventListener("pointerdown", (event) => divider.setPointerCapture(event.pointerId));
    divider.addEventListener("pointermove", (event) => {
      if (!divider.hasPointerCapture(event.pointerId)) return;
      const box = divider.parentElement.getBoundingClientRect();
      move((event.clientX - box.left) / box.width);
    });
    divider.addEventListener("keydown", (event) => {
      if (event.key === "ArrowLeft") move(this.state.divider - 0.02);
      if (event.key === "ArrowRight") move(this.state.divider + 0.02);
    });
  }

  followPointers(canvas) {
    const pointers = new Map();
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, event);
      this.moved = 0;
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return;
      const [dx, dy] = [event.clientX - before.clientX, event.clientY - before.clientY];
      this.moved += Math.abs(dx) + Math.abs(dy);
      if (pointers.size === 2) {
        const [other] = [...pointers.values()].filter((pointer) => pointer.pointerId !== event.pointerId);
        const span = (pointer) => Math.hypot(pointer.clientX - other.clientX, pointer.clientY - other.clientY);
        this.zoom(span(before) / Math.max(span(event), 1));
      } else {
        if (event.shiftKey || event.buttons === 2) this.moveLight(0.4 * dx, 0.4 * dy);
        else this.orbit(0.4 * dx, 0.4 * dy);
      }
      pointers.set(event.pointerId, event);
    });
    for (const kind of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(kind, (event) => {
        pointers.delete(event.pointerId);
        const ratio = canvas.width / canvas.clientWidth;
        if (kind === "pointerup" && this.moved < 4) this.pick(event.offsetX * ratio, event.offsetY * ratio);
      });
    }
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(0.001 * event.deltaY));
    }, { passive: false });
    this.pointers = pointers;
  }

  get dragging() {
    return this.pointers.size > 0;
  }

  key(event, light = event.shiftKey) {
    const arrows = { ArrowLeft: [-3, 0], ArrowRight: [3, 0], ArrowUp: [0, -3], ArrowDown: [0, 3] };
    if (event.key in arrows) {
      if (light) this.moveLight(...arrows[event.key]);
      else this.orbit(...arrows[event.key]);
    } else if (event.key === "+" || event.key === "=") this.zoom(0.9);
    else if (event.key === "-") this.zoom(1 / 0.9);
    else return;
    event.preventDefault();
  }
}
