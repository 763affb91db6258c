"use strict";
// All samples of a scene turn together: they differ in what the photograph does not show.
for (const scene of document.querySelectorAll(".samples")) {
  const tables = [...scene.querySelectorAll(".turntable")];
  const turn = (share) => {
    for (const table of tables) {
      const frames = Number(table.dataset.frames);
      const frame = Math.min(frames - 1, Math.max(0, Math.floor(share * frames)));
      const degrees = `${Math.round(360 * frame / frames)}`;
      table.firstElementChild.style.transform = `translateX(${-100 * frame / frames}%)`;
      table.setAttribute("aria-valuenow", frame);
      table.setAttribute("aria-valuetext", `${degrees} degrees`);
      table.parentElement.querySelector(".angle").textContent = `${degrees}°`;
    }
  };
  for (const table of tables) {
    const follow = (event) => {
      const box = table.getBoundingClientRect();
      turn((event.clientX - box.left) / box.width);
    };
    table.classList.add("live");
    table.scrollLeft = 0;
    table.addEventListener("pointerdown", (event) => {
      if (event.pointerType !== "mouse") table.setPointerCapture(event.pointerId);
      follow(event);
    });
    table.addEventListener("pointermove", follow);
    table.addEventListener("keydown", (event) => {
      const frames = Number(table.dataset.frames), now = Number(table.getAttribute("aria-valuenow"));
      const next = {
        ArrowRight: (now + 1) % frames, ArrowUp: (now + 1) % frames,
        ArrowLeft: (now + frames - 1) % frames, ArrowDown: (now + frames - 1) % frames,
        Home: 0, End: frames - 1,
      }[event.key];
      if (next === undefined) return;
      event.preventDefault();
      turn((next + 0.5) / frames);
    });
  }
}
