const BLINK_MS = 600;
const [BLINK, SIDE_BY_SIDE] = [3, 4];

for (const frame of document.querySelectorAll(".frame")) {
  const images = [...frame.querySelectorAll("img")];
  const buttons = [...frame.querySelectorAll("button")];
  const views = frame.querySelector(".views");
  let timer = 0;
  const show = (shown) => images.forEach((image, k) => image.classList.toggle("on", k === shown));
  const choose = (chosen) => {
    clearInterval(timer);
    buttons.forEach((button, k) => {
      button.classList.toggle("on", k === chosen);
      button.setAttribute("aria-pressed", String(k === chosen));
    });
    views.classList.toggle("all", chosen === SIDE_BY_SIDE);
    if (chosen < BLINK) show(chosen);
    if (chosen !== BLINK) return;
    let at = 0;
    show(at);
    timer = setInterval(() => show((at = 1 - at)), BLINK_MS);
  };
  buttons.forEach((button, k) => button.addEventListener("click", () => choose(k)));
  choose(0);
}
