/** The photo over the scene, up to a line that can be moved. */

/** Comparison of the photo with the scene in its view. */
export class Comparison {
  /**
   * @param {{overlay: HTMLCanvasElement, divider: HTMLElement, slider: HTMLInputElement, frame: HTMLElement}} parts
   */
  constructor(parts) {
    Object.assign(this, parts);
    this.isOn = false;
    this.slider.addEventListener("input", () => this.place());
    this.frame.addEventListener("pointermove", (event) => this.follow(event));
    this.frame.addEventListener("pointerdown", (event) => this.follow(event));
  }

  /** @param {ImageBitmap} photo */
  setPhoto(photo) {
    this.overlay.width = photo.width;
    this.overlay.height = photo.height;
    this.overlay.getContext("2d").drawImage(photo, 0, 0);
  }

  /** @param {boolean} isOn */
  set(isOn) {
    this.isOn = isOn;
    this.frame.classList.toggle("comparing", isOn);
    this.slider.hidden = !isOn;
    this.place();
  }

  /** Show the photo left of the line. */
  place() {
    const percent = Number(this.slider.value);
    this.overlay.style.clipPath = `inset(0 ${100 - percent}% 0 0)`;
    this.divider.style.left = `${percent}%`;
  }

  /** Move the line to the pointer. */
  follow(event) {
    if (this.isOn && (event.pointerType === "mouse" || event.buttons)) {
      const box = this.overlay.getBoundingClientRect();
      const share = (event.clientX - box.left) / box.width;
      this.slider.value = Math.round(100 * Math.min(Math.max(share, 0), 1));
      this.place();
    }
  }
}
