// Starts a viewer when its button is pressed: a page may hold more volumes than a browser draws at once.
for (const box of document.querySelectorAll(".viewer")) {
  const button = box.querySelector("button");
  const volume = (node, more) => niivue.NVImage.loadFromBase64({
    base64: node.textContent.trim(), name: node.dataset.title + ".nii.gz", ...more,
  });
  button.addEventListener("click", async () => {
    button.disabled = true;
    try {
      const canvases = [...box.querySelectorAll("canvas")];
      const overlays = [...box.querySelectorAll("script.overlay")];
      const image = box.querySelector("script.image");
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
      button.textContent = "This browser cannot show the viewer (WebGL 2 is needed); the figures above show the same. " + problem;
      box.dataset.state = "failed";
    }
  });
}
