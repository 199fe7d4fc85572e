/* Starts a viewer when its button is pressed: a page may hold more volumes than a browser draws at once. */
const unpacked = async (id) => {
  const packed = Uint8Array.from(atob(document.getElementById(id).textContent.trim()), (c) => c.charCodeAt(0));
  return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
};
const library = () => {
  window.niivueReady ??= (async () => {
    const code = document.createElement("script");
    code.textContent = new TextDecoder().decode(await unpacked("niivue"));
    document.head.append(code);
  })();
  return window.niivueReady;
};
/* A NIfTI file. If it has a description (byte 148), it holds each voxel less the one a row before it, to be smaller. */
const nifti = async (id) => {
  const file = await unpacked(id), bytes = new Uint8Array(file), header = new DataView(file);
  const row = header.getInt16(42, true);
  if (!bytes[148]) return bytes;
  for (let at = header.getFloat32(108, true) + row; at < bytes.length; at++) bytes[at] += bytes[at - row];
  return bytes;
};
/* As in the pictures: the patient's right is on the left of a coronal or axial slice, anterior of a sagittal one. */
const asRadiologistsRead = { isRadiologicalConvention: true, sagittalNoseLeft: true };
for (const box of document.querySelectorAll(".viewer")) {
  const button = box.querySelector("button");
  const volume = async (node, more) => {
    const name = node.dataset.title + ".nii", file = new File([await nifti(node.dataset.volume)], name);
    return Object.assign(await niivue.NVImage.loadFromFile({ file, name, ...more }), { colorbarVisible: !node.matches(".image") });
  };
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
        const view = new niivue.Niivue({ backColor: [1, 1, 1, 1], isColorbar: true, ...asRadiologistsRead });
        await view.attachToCanvas(canvas);
        view.addVolume(await volume(image, { colormap: "gray", cal_min: 0, cal_max: Number(image.dataset.most) }));
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
