// Mark tables, formulas, outputs and pictures that are wider than the page, see pages.css.
const BOXES = ".table-wrapper, .math-wrapper, pre, .cell_output .output, article p:has(> img), article a:has(img)";
const NARROW = 0.45; // share of the width that a first column may take and stay in sight

function mark() {
  for (const box of document.querySelectorAll(BOXES)) {
    box.classList.remove("scrolls"); // the hint itself changes the width
    const scrolls = box.scrollWidth > box.clientWidth + 1 && getComputedStyle(box).overflowX !== "visible";
    const first = box.querySelector("tr > :first-child");
    box.classList.toggle("scrolls", scrolls);
    box.classList.toggle("keeps-first", scrolls && first !== null && first.offsetWidth < NARROW * box.clientWidth);
  }
}

addEventListener("load", mark);
addEventListener("resize", mark);
document.addEventListener("toggle", mark, true); // a folded table has no width
