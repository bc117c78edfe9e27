/* Without this script all tables and drawings stand; with it tables sort and copy, and a frame can be asked what it is. */
"use strict";
const make = (name, properties = {}, children = []) => {
  const element = Object.assign(document.createElement(name), properties);
  element.append(...children);
  return element;
};

/* ---- tables ---- */
const number = (text) => {
  const found = text.replaceAll(",", "").match(/-?\d+(\.\d+)?(e[-+]?\d+)?/i);
  return found ? Number(found[0]) : NaN;
};

const sort = (table, heads, column) => {
  const head = heads[column], down = head.getAttribute("aria-sort") === "ascending", words = head.classList.contains("label");
  heads.forEach((other) => other.removeAttribute("aria-sort"));
  head.setAttribute("aria-sort", down ? "descending" : "ascending");
  const text = (row) => row.cells[column].textContent;
  const compare = (a, b) => {
    if (words) return (down ? -1 : 1) * text(a).localeCompare(text(b), undefined, { numeric: true });
    const [x, y] = [number(text(a)), number(text(b))];
    return Number.isNaN(x) || Number.isNaN(y) ? Number.isNaN(x) - Number.isNaN(y) : (down ? y - x : x - y);
  };
  for (const body of table.tBodies) body.append(...[...body.rows].filter((row) => !row.classList.contains("block")).sort(compare));
};

const plain = (cell) => cell.textContent.trim().replaceAll("\u2011", "-");
const spread = (row) => [...row.cells].flatMap((cell) => Array(cell.colSpan).fill(plain(cell)));
const content = (table) => {
  const [names, groups] = [...table.tHead.rows].reverse().map(spread);
  const rows = [...table.tBodies].flatMap((body) => [...body.rows]);
  return {
    labels: table.tHead.querySelectorAll("tr:last-child .label").length || 1,
    names: names.map((name, i) => groups?.[i] ? `${groups[i]}: ${name}` : name),
    rows: rows.map((row) => row.classList.contains("block") ? [plain(row), ...Array(names.length - 1).fill("")] : spread(row)),
  };
};
const LATEX = { "\\": "\\textbackslash{}", "~": "\\textasciitilde{}", "^": "\\textasciicircum{}", "°": "$^\\circ$", "×": "$\\times$", "±": "$\\pm$", "≤": "$\\leq$", "–": "--", "·": "$\\cdot$" };
const FORMATS = {
  CSV: ({ names, rows }) => [names, ...rows].map((row) => row.map((cell) => `"${cell.replaceAll('"', '""')}"`).join(",")).join("\n"),
  Markdown: ({ names, rows, labels }) => [names, names.map((_, i) => i < labels ? "---" : "---:"), ...rows]
    .map((row) => `| ${row.map((cell) => cell.replaceAll("|", "\\|")).join(" | ")} |`).join("\n"),
  LaTeX: ({ names, rows, labels }) => {
    const line = (row) => row.map((cell) => cell.replace(/[\\~^°×±≤–·]/g, (c) => LATEX[c]).replace(/[&%#_]/g, "\\$&")).join(" & ") + " \\\\";
    const columns = "l".repeat(labels) + "r".repeat(names.length - labels);
    return [`\\begin{tabular}{${columns}}`, "\\toprule", line(names), "\\midrule", ...rows.map(line), "\\bottomrule", "\\end{tabular}"].join("\n");
  },
};
const copy = (text) => {
  const field = make("textarea", { value: text });
  document.body.append(field);
  field.select();
  const done = document.execCommand("copy");  // the newer interface isn't there for a file from disk in every browser
  field.remove();
  return done;
};
for (const figure of document.querySelectorAll("figure.table")) {
  const tables = [...figure.querySelectorAll("table")], said = make("span", { role: "status" });
  for (const table of tables.filter((t) => !t.classList.contains("turned"))) {
    const heads = [...table.querySelectorAll("thead tr:last-child > th")];
    heads.forEach((head, column) => {
      const button = make("button", { type: "button", title: "sort" }, [...head.childNodes]);
      button.addEventListener("click", () => sort(table, heads, column));
      head.append(button);
    });
    table.classList.add("sorts");
  }
  const buttons = Object.entries(FORMATS).map(([name, write]) => {
    const button = make("button", { type: "button", textContent: name });
    button.addEventListener("click", () => {
      said.textContent = copy(tables.map((table) => write(content(table))).join("\n\n") + "\n") ? "copied" : "this browser doesn't let a page copy";
      button.focus();
    });
    return button;
  });
  figure.querySelector("figcaption").after(make("p", { className: "copies" }, ["copy as ", ...buttons, said]));
}

/* ---- the map, and the frame that is asked ---- */
for (const box of document.querySelectorAll(".frames")) {
  const data = JSON.parse(box.querySelector("script").textContent);
  const marks = [...box.querySelectorAll("circle")], by = box.querySelector("select");
  const slider = box.querySelector("input"), panel = box.querySelector(".frame"), legend = box.querySelector(".legend");
  const strip = box.querySelector(".strip");
  const steps = ["#00204d", "#31446b", "#666970", "#958f78", "#cbba69", "#ffea46"];  // cividis
  const say = (value, digits = 3) => value === null || value === undefined ? "–" : Number(value.toPrecision(digits)).toString();
  const rows = data.id.map((_, row) => row);

  for (const name of Object.keys(data.figures)) by.add(new Option(name, name));

  /* The chosen figure of every frame in order: dots over the walks, one after the other. */
  const draw = (values, most) => {
    const at = (row) => 1000 * (row + 0.5) / rows.length, high = (value) => 96 - 90 * Math.min(value / most, 1);
    const dot = (row) => `M${at(row).toFixed(1)} ${high(values[row]).toFixed(1)}h0`;
    const starts = rows.filter((row) => row && data.session[row] !== data.session[row - 1]);
    strip.querySelector(".dots").setAttribute("d", rows.filter((row) => values[row] !== null).map(dot).join(""));
    strip.querySelector(".starts").setAttribute("d", starts.map((row) => `M${at(row - 0.5).toFixed(1)} 0V100`).join(""));
  };

  const colour = () => {
    const values = data.figures[by.value], [xs, ys] = data.answers[by.value] ?? [[], []];
    const line = (mark) => xs[mark.dataset.row] == null || values[mark.dataset.row] === null ? "" : `M${mark.getAttribute("cx")} ${mark.getAttribute("cy")}L${xs[mark.dataset.row]} ${ys[mark.dataset.row]}`;
    box.querySelector(".answers").setAttribute("d", marks.map(line).join(""));
    legend.hidden = strip.parentElement.hidden = !values;
    box.classList.toggle("by-figure", Boolean(values));
    if (!values) return marks.forEach((mark) => mark.style.removeProperty("fill"));
    const known = values.filter((v) => v !== null).sort((a, b) => a - b);
    const most = known[Math.floor(0.95 * (known.length - 1))] || 1;
    for (const mark of marks) {
      const value = values[mark.dataset.row];
      mark.style.fill = value === null ? "transparent" : steps[Math.min(5, Math.floor(6 * value / most))];
    }
    legend.lastChild.textContent = ` ${say(most)} and more (95 % of frames are below); hollow: none${xs.length ? "; a line leads to the answer" : ""}`;
    draw(values, most);
  };

  /* The training frame that is nearest, of those that look the same way within 45° if there is any. */
  const nearest = (row) => {
    const apart = (other) => Math.hypot(...data.place.map((axis) => axis[row] - axis[other]));
    const turn = (other) => 360 / Math.PI * Math.acos(Math.min(1, Math.abs(data.rotation.reduce((sum, q) => sum + q[row] * q[other], 0))));
    const known = rows.filter((other) => other !== row && data.split[other] === "train" && data.place[0][other] !== null);
    if (data.place[0][row] === null || !known.length) return null;
    const alike = known.filter((other) => turn(other) < 45), among = alike.length ? alike : known;
    const best = among.reduce((a, b) => apart(a) <= apart(b) ? a : b);
    return { row: best, text: `${data.id[best]}, ${say(apart(best))} ${data.unit} and ${say(turn(best))}° away` };
  };

  const picture = (row) => data.image[row] ? [make("img", { src: data.image[row], alt: `frame ${data.id[row]}` })] : [];
  const show = (row) => {
    slider.value = row;
    slider.setAttribute("aria-valuetext", data.id[row]);
    marks.forEach((mark) => mark.classList.toggle("chosen", mark.dataset.row === String(row)));
    strip.querySelector(".now").setAttribute("d", `M${(1000 * (row + 0.5) / rows.length).toFixed(1)} 0V100`);
    const near = nearest(row), said = Object.entries(data.refusals).filter(([, why]) => why[row]);
    const facts = [
      ["class", data.class[row] + (data.reason[row] ? `: ${data.reason[row].replace(/^class .: /, "")}` : "")],
      ["split", data.split[row]],
      ["time", data.time[row] === null ? "–" : `${say(data.time[row], 4)} s`],
      [`position (${data.unit})`, data.place.map((axis) => say(axis[row], 4)).join(", ")],
      ["rotation (w, x, y, z)", data.rotation.map((axis) => say(axis[row], 4)).join(", ")],
      ...Object.entries(data.figures).map(([name, values]) => [name, say(values[row])]),
      ...said.map(([name, why]) => [`${name} refused`, why[row]]),
      ...(near ? [["nearest training frame", near.text]] : []),
    ];
    const list = make("dl", {}, facts.flatMap(([name, text]) => [make("dt", { textContent: name }), make("dd", { textContent: text })]));
    panel.replaceChildren(make("h3", { textContent: data.id[row] }), ...picture(row), list, ...(near ? picture(near.row) : []));
  };

  by.addEventListener("change", colour);
  slider.addEventListener("input", () => show(Number(slider.value)));
  strip.addEventListener("click", (event) => {
    const { left, width } = strip.getBoundingClientRect();
    show(Math.max(0, Math.min(rows.length - 1, Math.floor(rows.length * (event.clientX - left) / width))));
  });
  box.querySelector("svg.walk").addEventListener("click", (event) => {
    const at = marks.map((mark) => {
      const place = mark.getBoundingClientRect();
      return Math.hypot(place.x + place.width / 2 - event.clientX, place.y + place.height / 2 - event.clientY);
    });
    if (marks.length) show(Number(marks[at.indexOf(Math.min(...at))].dataset.row));
  });
  /* Which share of the test frames is within an error, by localiser. */
  const recall = box.querySelector(".recall"), [session, limit] = recall.querySelectorAll("select, input");
  const curves = data.recall.map(({ name, colour, fused }) => {
    const path = document.createElementNS("http://www.w3.org/2000/svg", "path"), line = make("i", { className: "line" });
    const shown = make("input", { type: "checkbox", checked: true }), share = make("b");
    path.style.stroke = line.style.borderColor = colour;
    if (!fused) path.style.strokeDasharray = "6 4", line.style.borderTopStyle = "dashed";
    recall.querySelector("svg").append(path);
    recall.querySelector(".about").before(make("label", { className: "key" }, [shown, line, `${name} `, share]));
    return { path, shown, share };
  });
  const compared = new Set(data.compared);  // where only some sessions are fused, the frames of these
  const error = (step) => 10 ** (3 * step / 100 - 2);
  const count = () => {
    recall.querySelector("output").textContent = `${say(error(limit.value))} ${data.unit}`;
    recall.querySelector(".now").setAttribute("d", `M${10 * limit.value} 0V100`);
    data.recall.forEach(({ name, rows: tested }, i) => {
      const asked = tested.filter((row) => session.value ? data.session[row] === session.value : compared.has(row));
      const errors = asked.map((row) => data.figures[name]?.[row] ?? Infinity);
      const within = (step) => 100 * errors.filter((e) => e <= error(step)).length / errors.length;
      const points = curves[i].shown.checked && errors.length ? Array.from({ length: 101 }, (_, step) => `${10 * step} ${(100 - within(step)).toFixed(1)}`) : [];
      curves[i].path.setAttribute("d", points.length ? `M${points.join("L")}` : "");
      curves[i].share.textContent = errors.length ? `${within(limit.value).toFixed(1)} %` : "–";
    });
  };
  for (const name of new Set(data.recall.flatMap((r) => r.rows.map((row) => data.session[row])))) session.add(new Option(name, name));
  recall.addEventListener("input", count);
  recall.hidden = !data.recall.length;
  if (data.recall.length) count();

  box.querySelector(".controls").hidden = false;
  if (data.id.length) show(0);
}
