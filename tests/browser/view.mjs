// Looks at a recording as a user does: node view.mjs METROMAP FILE.rrd OUT.png
//
// Starts `METROMAP view FILE`, opens the page it names in a headless Chromium, waits until every view has drawn what
// belongs into it, writes the picture, and ends all it started. Exit code 0 only if all of that worked.
// CHROMIUM names another browser than /usr/bin/chromium, VIEW_S_MAX another patience than 240 s.

import { spawn } from "node:child_process";
import { once } from "node:events";
import { writeFileSync } from "node:fs";
import { setTimeout as sleep } from "node:timers/promises";
import { chromium } from "playwright-core";
import { PNG } from "pngjs";

const WIDTH = 1280;
const HEIGHT = 800;

// The viewer takes in a little of the file each frame. Without a graphics card, frames of this size are quick ones.
const SMALL = { width: 400, height: 250 };

const PATIENCE_S = Number(process.env.VIEW_S_MAX ?? 240);

// Where the layout puts the views, as shares of the window: left, top, right, bottom. Tabs and frames are left out.
const SCENE = [0.01, 0.08, 0.61, 0.94];
const CAMERA = [0.64, 0.08, 0.99, 0.3];
const PLAN = [0.64, 0.36, 0.99, 0.58];
const PLOT = [0.64, 0.63, 0.99, 0.77];

const hueIn = (low, high) => ({ h, s, v }) => s > 0.45 && v > 0.3 && h >= low && h <= high;
const isGreenGrey = ({ r, g, b, s }) => s > 0.08 && s < 0.3 && g > r && g > 90 && g < 190 && b > r;

// What must be seen: where, what, in at least which share of that view, and which pixels count.
const EXPECTED = [
  [SCENE, "measured points (yellow to blue)", 0.0005, hueIn(50, 245)],
  [SCENE, "bodies (shaded, pale)", 0.02, ({ s, v }) => s < 0.3 && v > 0.25 && v < 0.97],
  [CAMERA, "an image or a line", 0.0002, ({ v }) => v > 0.12],
  [PLAN, "unknown cells (grey-green)", 0.002, isGreenGrey],
  [PLAN, "free cells (white)", 0.002, ({ s, v }) => s < 0.05 && v > 0.95],
  [PLOT, "curves (red, green or blue)", 0.0003, ({ s, v }) => s > 0.4 && v > 0.5],
];

// Fewer different colours than this are text on a page, not a lit scene.
const SCENE_COLOURS_MIN = 80;

function pixel(picture, x, y) {
  const at = 4 * (y * picture.width + x);
  const [r, g, b] = picture.data.subarray(at, at + 3);
  const [high, low] = [Math.max(r, g, b), Math.min(r, g, b)];
  const range = high - low;
  let h = 0;
  if (range > 0) {
    if (high === r) h = ((g - b) / range + 6) % 6;
    else if (high === g) h = (b - r) / range + 2;
    else h = (r - g) / range + 4;
  }
  return { r, g, b, h: h * 60, s: high > 0 ? range / high : 0, v: high / 255 };
}

function* pixelsOf(picture, [left, top, right, bottom]) {
  for (let y = Math.round(top * picture.height); y < bottom * picture.height; y++) {
    for (let x = Math.round(left * picture.width); x < right * picture.width; x++) yield pixel(picture, x, y);
  }
}

/** What of EXPECTED is not in the picture, with the shares found. */
function missing(picture) {
  const reasons = [];
  for (const [view, what, atLeast, counts] of EXPECTED) {
    let [all, seen] = [0, 0];
    for (const p of pixelsOf(picture, view)) {
      all += 1;
      if (counts(p)) seen += 1;
    }
    const found = all > 0 ? seen / all : 0;
    if (!(found >= atLeast)) reasons.push(`${what}: ${(100 * found).toFixed(4)} % of its view, not ${100 * atLeast} %`);
  }
  const colours = new Set();
  for (const { r, g, b } of pixelsOf(picture, SCENE)) colours.add((r >> 3) * 1024 + (g >> 3) * 32 + (b >> 3));
  if (colours.size < SCENE_COLOURS_MIN) reasons.push(`the scene: ${colours.size} colours, not ${SCENE_COLOURS_MIN}`);
  return reasons;
}

/** Share of pixels that differ clearly between two pictures of one size. */
function change(one, other) {
  let changed = 0;
  for (let at = 0; at < one.data.length; at += 4) {
    if ([0, 1, 2].some((c) => Math.abs(one.data[at + c] - other.data[at + c]) > 40)) changed += 1;
  }
  return changed / (one.data.length / 4);
}

/** Starts the viewer and gives it with the page it names on stderr. */
async function serve(metromap, file) {
  const server = spawn(metromap, ["view", file, "--port", "0", "--no-browser"], { stdio: ["ignore", "ignore", "pipe"] });
  const said = [];
  const url = new Promise((resolve, reject) => {
    server.on("error", reject);
    server.on("exit", (code) => reject(new Error(`${metromap} view ended with ${code}: ${said.join("").trim()}`)));
    server.stderr.on("data", (text) => {
      said.push(String(text));
      const found = said.join("").match(/open this: (http:\S+)\s/);
      if (found) resolve(found[1]);
    });
  });
  const late = sleep(30_000, undefined, { ref: false }).then(() => Promise.reject(new Error("metromap view named no page in 30 s")));
  try {
    return { server, url: await Promise.race([url, late]) };
  } catch (error) {
    server.kill("SIGKILL");
    throw error;
  }
}

/** Ctrl-C must end the viewer well. */
async function interrupt(server) {
  if (server.exitCode !== null) throw new Error(`metromap view ended by itself with ${server.exitCode}`);
  const exit = once(server, "exit");
  server.kill("SIGINT");
  const code = await Promise.race([exit.then(([code]) => code), sleep(10_000, "no end in 10 s", { ref: false })]);
  if (code !== 0) {
    server.kill("SIGKILL");
    throw new Error(`after Ctrl-C, metromap view ended with ${code}, not 0`);
  }
}

/** A picture of the page, decoded; nothing if the page is too busy to give one. */
async function shoot(page) {
  try {
    const bytes = await page.screenshot({ timeout: 60_000 });
    return { bytes, picture: PNG.sync.read(bytes) };
  } catch (error) {
    if (error.name !== "TimeoutError") throw error;
    return undefined;
  }
}

/** Waits until the page has taken in the whole file: the time it shows grows until then. */
async function load(page, deadline) {
  let before;
  while (Date.now() < deadline) {
    await sleep(4000);
    const shot = await shoot(page);
    if (!shot) continue;
    const colours = new Set(new Uint32Array(Uint8Array.from(shot.picture.data).buffer)).size;
    if (before && colours > 1000 && change(before, shot.picture) === 0) return;
    before = shot.picture;
  }
  throw new Error(`the page was still loading after ${PATIENCE_S} s`);
}

async function look(browser, url, out) {
  const page = await browser.newPage({ viewport: SMALL, colorScheme: "dark" });
  const heard = [];
  page.on("console", (message) => message.type() === "error" && heard.push(message.text()));
  page.on("pageerror", (error) => heard.push(String(error)));
  const deadline = Date.now() + 1000 * PATIENCE_S;
  let reasons = ["no picture"];
  try {
    await page.goto(`${url}&renderer=webgl`);
    await load(page, deadline);
    await page.setViewportSize({ width: WIDTH, height: HEIGHT });
    while (Date.now() < deadline) {
      await sleep(4000);
      const shot = await shoot(page);
      if (!shot) continue;
      writeFileSync(out, shot.bytes);
      reasons = missing(shot.picture);
      if (reasons.length === 0) return;
    }
    throw new Error(`after ${PATIENCE_S} s the page does not show:\n  ${reasons.join("\n  ")}`);
  } catch (error) {
    // Without a network the page complains that it finds no fonts: that is no reason.
    const last = heard.filter((line) => !/fetch|ERR_/.test(line)).slice(-5).map((line) => line.slice(0, 200));
    throw new Error([error.message, ...last.map((line) => `its console: ${line}`)].join("\n"));
  }
}

async function main() {
  const [metromap, file, out] = process.argv.slice(2);
  if (!out) throw new Error("usage: node view.mjs METROMAP FILE.rrd OUT.png");
  const { server, url } = await serve(metromap, file);
  let browser;
  try {
    browser = await chromium.launch({
      executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
      args: [
        "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
        "--ignore-gpu-blocklist", "--disable-background-networking", "--disable-component-update", "--disable-sync",
        "--no-first-run", "--disable-quic",
      ],
    });
    const began = Date.now();
    await look(browser, url, out);
    console.log(`${out}: every view is drawn, ${((Date.now() - began) / 1000).toFixed(0)} s after the browser started`);
    await browser.close();
    browser = undefined;
    await interrupt(server);
  } finally {
    await browser?.close();
    if (server.exitCode === null) server.kill("SIGKILL");
  }
}

main().catch((error) => {
  console.error(error.message ?? error);
  process.exitCode = 1;
});
