"""What a page must be in a browser, as expressions that the page evaluates: it fits, is legible, and has names."""

from __future__ import annotations

from pathlib import Path

from tests.browser import Tab

WIDTHS = (1400, 800, 400)  # CSS pixels
UNFOLD = "document.querySelectorAll('main details').forEach((part) => { part.open = true; })"
TOO_WIDE = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
PALE = """(() => {
  const channels = (colour) => colour.match(/[\\d.]+/g).map(Number);
  const luminance = (colour) => {
    const [r, g, b] = channels(colour).map((c) => (c /= 255) <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const ground = (node) => {
    const layers = [];
    for (; node && (layers.at(-1)?.[3] ?? 0) < 1; node = node.parentElement) {
      const [r, g, b, alpha = 1] = channels(getComputedStyle(node).backgroundColor);
      if (alpha > 0) layers.push([r, g, b, alpha]);
    }
    const over = (below, above) => below.map((c, k) => above[3] * above[k] + (1 - above[3]) * c);
    return `rgb(${layers.reduceRight(over, [255, 255, 255])})`;
  };
  const texts = document.createTreeWalker(document.querySelector(".page"), NodeFilter.SHOW_TEXT), pale = [];
  let seen = 0;
  while (texts.nextNode()) {
    const words = texts.currentNode.textContent.trim(), node = texts.currentNode.parentElement;
    if (!words || !node.checkVisibility()) continue;
    seen += 1;
    const [light, dark] = [luminance(getComputedStyle(node).color), luminance(ground(node))].sort((a, b) => b - a);
    const contrast = (light + 0.05) / (dark + 0.05), size = parseFloat(getComputedStyle(node).fontSize);
    if (contrast < 4.5 || size < 12) pale.push(`${words}: contrast ${contrast.toFixed(2)}, ${size} px`);
  }
  return seen > 20 ? pale : ["hardly any text is seen"];
})()"""
"""Texts with less contrast than WCAG 2.2 asks for (AA, 1.4.3), or in small type."""
HEADINGS = (
    """[...document.querySelectorAll("main h1, main h2, main h3, main h4")].map((one) => Number(one.tagName[1]))"""
)
UNNAMED = """[
  ...[...document.querySelectorAll("img")].filter((one) => !one.alt.trim()),
  ...[...document.querySelectorAll("input")].filter((one) => !one.labels.length || !one.labels[0].textContent.trim()),
  ...[...document.querySelectorAll("button, summary, a")].filter((one) => !one.textContent.trim()),
  ...[...document.querySelectorAll("th")].filter((one) => !one.scope),
].map((one) => one.outerHTML.slice(0, 80))"""
CUT_OFF = """[...document.querySelectorAll("figure img")].filter((one) => one.checkVisibility()).map((one) => {
  const box = one.closest(".stack"), scrolls = box && getComputedStyle(box).overflowX === "auto";
  const seen = one.closest("figure").getBoundingClientRect(), whole = (scrolls ? box : one).getBoundingClientRect();
  return Math.max(seen.left - whole.left, whole.right - seen.right, whole.right - innerWidth);
}).filter((pixels) => pixels > 0.5)"""
"""Pixels by which pictures, or the boxes in which they scroll, are wider than their figure, or than the window."""
BROKEN = """[...document.querySelectorAll("td, th")].flatMap((cell) => {
  const text = cell.textContent, from = text.indexOf("("), range = document.createRange();
  if (!cell.checkVisibility() || from < 0 && (text.length > 18 || cell.closest("thead"))) return [];
  const walk = document.createTreeWalker(cell, NodeFilter.SHOW_TEXT), tops = new Set();
  while (walk.nextNode()) {
    if (from >= 0 && !walk.currentNode.data.includes("(")) continue;
    range.setStart(walk.currentNode, Math.max(walk.currentNode.data.indexOf("("), 0));
    range.setEnd(walk.currentNode, walk.currentNode.data.length);
    [...range.getClientRects()].forEach((line) => tops.add(Math.round(line.top)));
  }
  return tops.size > 1 ? [text] : [];
})"""
"""Short cells, and intervals in brackets, that are broken between lines."""
NO_WEBGL = "HTMLCanvasElement.prototype.getContext = () => null"


def opened(tab: Tab, page: Path, width: int) -> None:
    """The page in a window of a width, as a person first sees it."""
    screen = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 1000}
    tab.call("Emulation.setDeviceMetricsOverride", **screen)
    tab.open(page)
