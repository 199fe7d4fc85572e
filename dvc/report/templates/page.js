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
/* On a narrow screen a picture fits it, or is large in a box of its own that scrolls. */
document.querySelectorAll(".enlarge").forEach((button) => button.addEventListener("click", () => {
  const picture = button.parentElement.querySelector(".stack"), large = picture.classList.toggle("large");
  picture.tabIndex = large ? 0 : -1;
  button.textContent = large ? "Show the whole picture" : "Enlarge the picture";
}));
