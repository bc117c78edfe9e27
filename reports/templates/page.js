/* Without this script all tables and drawings stand; with it a frame can be asked what it is. */
"use strict";
for (const box of document.querySelectorAll(".frames")) {
  const data = JSON.parse(box.querySelector("script").textContent);
  const marks = [...box.querySelectorAll("circle")], by = box.querySelector("select");
  const slider = box.querySelector("input"), panel = box.querySelector(".frame"), legend = box.querySelector(".legend");
  const steps = ["#00204d", "#31446b", "#666970", "#958f78", "#cbba69", "#ffea46"];  // cividis
  const say = (value, digits = 3) => value === null || value === undefined ? "–" : Number(value.toPrecision(digits)).toString();

  for (const name of Object.keys(data.figures)) by.add(new Option(name, name));

  const colour = () => {
    const values = data.figures[by.value];
    legend.hidden = !values;
    box.classList.toggle("by-figure", Boolean(values));
    if (!values) return marks.forEach((mark) => mark.style.removeProperty("fill"));
    const known = values.filter((v) => v !== null).sort((a, b) => a - b);
    const most = known[Math.floor(0.95 * (known.length - 1))] || 1;
    for (const mark of marks) {
      const value = values[mark.dataset.row];
      mark.style.fill = value === null ? "transparent" : steps[Math.min(5, Math.floor(6 * value / most))];
    }
    legend.lastChild.textContent = ` ${say(most)} and more (95 % of frames are below); hollow: none`;
  };

  const show = (row) => {
    slider.value = row;
    slider.setAttribute("aria-valuetext", data.id[row]);
    marks.forEach((mark) => mark.classList.toggle("chosen", mark.dataset.row === String(row)));
    const facts = [
      ["class", data.class[row] + (data.reason[row] ? `: ${data.reason[row]}` : "")],
      ["split", data.split[row]],
      ["time", data.time[row] === null ? "–" : `${say(data.time[row], 4)} s`],
      [`position (${data.unit})`, data.place.map((axis) => say(axis[row], 4)).join(", ")],
      ...Object.entries(data.figures).map(([name, values]) => [name, say(values[row])]),
    ];
    const list = document.createElement("dl");
    for (const [name, text] of facts) {
      list.append(Object.assign(document.createElement("dt"), { textContent: name }));
      list.append(Object.assign(document.createElement("dd"), { textContent: text }));
    }
    const title = Object.assign(document.createElement("h3"), { textContent: data.id[row] });
    const image = Object.assign(document.createElement("img"), { src: data.image[row], alt: `frame ${data.id[row]}` });
    panel.replaceChildren(title, ...(data.image[row] ? [image] : []), list);
  };

  by.addEventListener("change", colour);
  slider.addEventListener("input", () => show(Number(slider.value)));
  box.querySelector("svg").addEventListener("click", (event) => {
    const at = marks.map((mark) => {
      const place = mark.getBoundingClientRect();
      return Math.hypot(place.x + place.width / 2 - event.clientX, place.y + place.height / 2 - event.clientY);
    });
    if (marks.length) show(Number(marks[at.indexOf(Math.min(...at))].dataset.row));
  });
  box.querySelector(".controls").hidden = false;
  if (data.id.length) show(0);
}
