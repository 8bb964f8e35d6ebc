/** What the layers of the map draw on: a canvas, or an SVG picture with the same few functions. */

export interface Surface {
  fillStyle: string | CanvasGradient | CanvasPattern;
  strokeStyle: string | CanvasGradient | CanvasPattern;
  lineWidth: number;
  lineJoin: CanvasLineJoin;
  lineCap: CanvasLineCap;
  font: string;
  textAlign: CanvasTextAlign;
  textBaseline: CanvasTextBaseline;
  globalAlpha: number;
  beginPath(): void;
  moveTo(x: number, y: number): void;
  lineTo(x: number, y: number): void;
  closePath(): void;
  arc(x: number, y: number, radius: number, from: number, to: number): void;
  ellipse(x: number, y: number, rx: number, ry: number, turn: number, from: number, to: number): void;
  rect(x: number, y: number, width: number, height: number): void;
  fill(rule?: CanvasFillRule): void;
  stroke(): void;
  fillText(text: string, x: number, y: number): void;
  strokeText(text: string, x: number, y: number): void;
  measureText(text: string): { width: number };
  setLineDash(segments: number[]): void;
}

/** Records the calls as SVG. Text widths are measured on a canvas. */
export class SvgSurface implements Surface {
  fillStyle = "#000";
  strokeStyle = "#000";
  lineWidth = 1;
  lineJoin: CanvasLineJoin = "miter";
  lineCap: CanvasLineCap = "butt";
  font = "10px sans-serif";
  textAlign: CanvasTextAlign = "start";
  textBaseline: CanvasTextBaseline = "alphabetic";
  globalAlpha = 1;
  private dash: number[] = [];
  private path = "";
  private readonly parts: string[] = [];

  constructor(
    private readonly width: number,
    private readonly height: number,
    private readonly measure: (font: string, text: string) => number,
  ) {}

  beginPath() {
    this.path = "";
  }
  moveTo(x: number, y: number) {
    this.path += `M${short(x)} ${short(y)}`;
  }
  lineTo(x: number, y: number) {
    this.path += `${this.path === "" ? "M" : "L"}${short(x)} ${short(y)}`;
  }
  closePath() {
    this.path += "Z";
  }
  arc(x: number, y: number, radius: number, from: number, to: number) {
    this.ellipse(x, y, radius, radius, 0, from, to);
  }
  ellipse(x: number, y: number, rx: number, ry: number, turn: number, from: number, to: number) {
    const at = (angle: number) => {
      const [px, py] = [rx * Math.cos(angle), ry * Math.sin(angle)];
      return `${short(x + px * Math.cos(turn) - py * Math.sin(turn))} ${short(y + px * Math.sin(turn) + py * Math.cos(turn))}`;
    };
    const degrees = short((turn * 180) / Math.PI);
    const radii = `${short(rx)} ${short(ry)} ${degrees}`;
    const whole = Math.abs(to - from) >= 2 * Math.PI - 1e-6;
    const middle = (from + to) / 2;
    this.path += `M${at(from)}A${radii} 0 1 ${at(middle)}A${radii} 0 1 ${at(to)}${whole ? "Z" : ""}`;
  }
  rect(x: number, y: number, width: number, height: number) {
    this.path += `M${short(x)} ${short(y)}h${short(width)}v${short(height)}h${short(-width)}Z`;
  }
  fill(rule: CanvasFillRule = "nonzero") {
    this.add(`<path d="${this.path}" fill="${escaped(String(this.fillStyle))}" fill-rule="${rule}"${this.alpha()}/>`);
  }
  stroke() {
    const dash = this.dash.length > 0 ? ` stroke-dasharray="${this.dash.join(" ")}"` : "";
    this.add(`<path d="${this.path}" fill="none" ${this.pen()}${dash}${this.alpha()}/>`);
  }
  fillText(text: string, x: number, y: number) {
    this.text(text, x, y, `fill="${escaped(String(this.fillStyle))}"`);
  }
  strokeText(text: string, x: number, y: number) {
    this.text(text, x, y, `fill="none" ${this.pen()}`);
  }
  measureText(text: string) {
    return { width: this.measure(this.font, text) };
  }
  setLineDash(segments: number[]) {
    this.dash = segments;
  }

  document(ground: string): string {
    const size = `width="${this.width}" height="${this.height}" viewBox="0 0 ${this.width} ${this.height}"`;
    return (
      `<svg xmlns="http://www.w3.org/2000/svg" ${size}>` +
      `<rect width="100%" height="100%" fill="${ground}"/>${this.parts.join("\n")}</svg>\n`
    );
  }

  private pen(): string {
    return (
      `stroke="${escaped(String(this.strokeStyle))}" stroke-width="${short(this.lineWidth)}" ` +
      `stroke-linejoin="${this.lineJoin}" stroke-linecap="${this.lineCap}"`
    );
  }
  private alpha(): string {
    return this.globalAlpha === 1 ? "" : ` opacity="${short(this.globalAlpha)}"`;
  }
  private text(text: string, x: number, y: number, style: string) {
    const anchor = { center: "middle", right: "end", end: "end" }[this.textAlign as string] ?? "start";
    const baseline = { middle: "central", top: "hanging" }[this.textBaseline as string] ?? "alphabetic";
    this.add(
      `<text x="${short(x)}" y="${short(y)}" text-anchor="${anchor}" dominant-baseline="${baseline}" ` +
        `style="font:${escaped(this.font)}" ${style}${this.alpha()}>${escaped(text)}</text>`,
    );
  }
  private add(part: string) {
    this.parts.push(part);
  }
}

function short(value: number): string {
  return String(Math.round(value * 100) / 100);
}

/** A text as XML: no character of it is read as markup, none is forbidden there. */
export function escaped(text: string): string {
  return text
    .replace(/[\u0000-\u0008\u000b\u000c\u000e-\u001f\ufffe\uffff]/g, "\ufffd")
    .replace(/[&<>"']/g, (char) => `&#${char.charCodeAt(0)};`);
}
