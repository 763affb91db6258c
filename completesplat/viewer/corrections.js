// viser's program stands compressed in the page, and is put into the document as a text. Of that text,
// - the square on which splats are drawn gets corners of three numbers: of two, three.js measures a bounding sphere of
//   radius NaN, and says so as an error; the square is no place of the scene, and must not be culled by that sphere;
// - the panel of narrow windows is folded at first, since it would cover most of the scene.
document.head.appendChild = function (node) {
  if (node.type === "module")
    node.textContent = node.textContent
      .replace("[-2,-2,2,-2,2,2,-2,2]),2)", "[-2,-2,0,2,-2,0,2,2,0,-2,2,0]),3)")
      .replace(/(`mesh`,\{ref:\w+,geometry:\w+\.geometry,)(material:\w+\.material,renderOrder:)/, "$1frustumCulled:!1,$2")
      .replace(/(\{toggle:\w+\}\]=\w+\()!0(\);return\(0,\w+\.jsx\)\(\w+\.Provider,\{value:\{wrapperRef:)/, "$1!1$2");
  return Node.prototype.appendChild.call(this, node);
};
// A file that is dropped on the page goes to its upload button.
addEventListener("dragover", (event) => event.preventDefault());
addEventListener("drop", (event) => {
  const input = document.querySelector("input[type=file]");
  event.preventDefault();
  if (!input || !event.dataTransfer.files.length) return;
  input.files = event.dataTransfer.files;
  input.dispatchEvent(new Event("change", { bubbles: true }));
});
