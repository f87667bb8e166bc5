for (const box of document.querySelectorAll(".frame")) {
  const images = box.querySelectorAll("img"), buttons = box.querySelectorAll("button"); let timer = 0;
  const show = k => { images.forEach((one, i) => one.classList.toggle("on", i === k));
    buttons.forEach((one, i) => one.classList.toggle("on", i === k)); };
  const all = on => box.querySelector(".views").classList.toggle("all", on);
  buttons.forEach((one, k) => one.addEventListener("click", () => { clearInterval(timer); timer = 0; all(k === 4);
    if (k !== 3) { show(k); return; } let at = 0; show(0); timer = setInterval(() => show(at = 1 - at), 600); }));
  all(true); show(4);
}
