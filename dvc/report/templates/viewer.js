/* Starts a viewer when its button is pressed: a page may hold more volumes than a browser draws at once. */
const library = () => {
  window.niivueReady ??= (async () => {
    const packed = Uint8Array.from(atob(document.getElementById("niivue").textContent.trim()), (c) => c.charCodeAt(0));
    const code = document.createElement("script");
    code.textContent = await new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
    document.head.append(code);
  })();
  return window.niivueReady;
};
for (const box of document.querySelectorAll(".viewer")) {
  const button = box.querySelector("button");
  const volume = (node, more) => niivue.NVImage.loadFromBase64({
    base64: document.getElementById(node.dataset.volume).textContent.trim(), name: node.dataset.title + ".nii.gz", ...more,
  });
  button.addEventListener("click", async () => {
    button.disabled = true;
    try {
      await library();
      const canvases = [...box.querySelectorAll("canvas")];
      const overlays = [...box.querySelectorAll(".overlay")];
      const image = box.querySelector(".image");
      const shown = [];
      for (const [number, canvas] of canvases.entries()) {
        canvas.parentElement.hidden = false;
        const view = new niivue.Niivue({ backColor: [1, 1, 1, 1], isColorbar: true });
        await view.attachToCanvas(canvas);
        view.addVolume(await volume(image, { colormap: "gray", cal_min: 0, cal_max: Number(image.dataset.most), colorbarVisible: false }));
        const scale = Number(overlays[number].dataset.most);
        view.addVolume(await volume(overlays[number], { colormap: "viridis", opacity: 0.75, cal_min: scale / 100, cal_max: scale }));
        view.setSliceType(view.sliceTypeMultiplanar);
        shown.push(view);
      }
      for (const view of shown) view.broadcastTo(shown.filter((other) => other !== view), { "2d": true, "3d": true });
      button.remove();
      box.dataset.state = "shown";
    } catch (problem) {
      button.textContent = "The viewer could not start (it needs WebGL 2); the pictures above show the same strain. " + problem;
      box.dataset.state = "failed";
    }
  });
}
