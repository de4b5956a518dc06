"use strict";
// Each slider shows an image of its view's cards over the ground truth, from the chosen border on.
for (const view of document.querySelectorAll(".view")) {
  const slider = view.querySelector(".slider");
  if (!slider) continue;
  const cards = [...view.querySelectorAll(".card")];
  const image = (card) => card.querySelector(".whole img").src;
  const below = slider.querySelector(".below"), above = slider.querySelector(".above");
  const select = slider.querySelector("select"), range = slider.querySelector("input");
  for (const card of cards.slice(1)) {
    const option = document.createElement("option");
    option.textContent = card.dataset.name;
    select.append(option);
  }
  const update = () => {
    above.src = image(cards[1 + select.selectedIndex]);
    above.style.clipPath = `inset(0 0 0 ${range.value}%)`;
  };
  below.src = image(cards[0]);
  select.addEventListener("change", update);
  range.addEventListener("input", update);
  update();
  slider.hidden = false;
}
document.documentElement.dataset.ready = "yes";
