/* On a narrow screen the contents stand above the page: the answer comes first. */
const contents = document.getElementById("contents");
if (contents && matchMedia("(max-width: 68rem)").matches) contents.open = false;
/* Folded parts open for a link that leads there, and for print. */
const unfolded = () => {
  const part = location.hash.length > 1 && document.getElementById(location.hash.slice(1));
  if (part && part.tagName === "DETAILS") { part.open = true; part.scrollIntoView(); }
};
addEventListener("hashchange", unfolded);
addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((part) => { part.open = true; }));
document.querySelectorAll("nav a").forEach((link) => link.addEventListener("click", () => {
  document.querySelector(link.getAttribute("href")).open = true;
}));
unfolded();
/* A picture beneath others is stored once, and copied where it lies beneath more. */
document.querySelectorAll("[data-copy]").forEach((picture) => { picture.src = document.getElementById(picture.dataset.copy).src; });
/* Pictures on top of one another fade. */
document.querySelectorAll(".faders").forEach((faders) => {
  const over = faders.previousElementSibling.querySelectorAll(".over");
  faders.querySelectorAll("input").forEach((fader, number) => fader.addEventListener("input", () => {
    over[number].style.opacity = fader.value / 100;
  }));
});
/* On a narrow screen a picture is large in a box of its own that scrolls, by keys too, or fits the screen. */
const narrow = matchMedia("(max-width: 49.9rem)"); /* as in page.css */
const reachable = (box) => {
  const title = box.closest("figure").querySelector("h3").textContent;
  const told = { tabindex: "0", role: "group", "aria-label": `${title} (scrolls sideways)` };
  const scrolls = narrow.matches && !box.classList.contains("fitted");
  Object.entries(told).forEach(([name, value]) => (scrolls ? box.setAttribute(name, value) : box.removeAttribute(name)));
};
document.querySelectorAll(".stack").forEach((box) => {
  const button = box.closest("figure").querySelector(".fit");
  button.addEventListener("click", () => {
    button.textContent = box.classList.toggle("fitted") ? "Enlarge the picture" : "Show the whole picture";
    reachable(box);
  });
  narrow.addEventListener("change", () => reachable(box));
  reachable(box);
});
