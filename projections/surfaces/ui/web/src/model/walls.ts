/** Walls as closed outlines, to be filled: the even-odd rule leaves the free cells between them. */

export type Segment = readonly [number, number, number, number];

const known = new WeakMap<readonly Segment[], number[][]>();

/** x0, y0, x1, y1 … of each outline, in metres. Two segments meet at each end of a segment. */
export function outlinesOf(walls: readonly Segment[]): number[][] {
  let outlines = known.get(walls);
  if (outlines === undefined) known.set(walls, (outlines = chained(walls)));
  return outlines;
}

function chained(walls: readonly Segment[]): number[][] {
  const at = new Map<string, number[]>();
  const key = (x: number, y: number) => `${x} ${y}`;
  walls.forEach(([x0, y0, x1, y1], row) => {
    for (const end of [key(x0, y0), key(x1, y1)]) at.get(end)?.push(row) ?? at.set(end, [row]);
  });
  const used = new Set<number>();
  const outlines: number[][] = [];
  walls.forEach(([x0, y0], start) => {
    const outline: number[] = [];
    let [x, y] = [x0, y0];
    for (let row: number | undefined = start; row !== undefined && !used.has(row); row = at.get(key(x, y))?.find((each) => !used.has(each))) {
      used.add(row);
      outline.push(x, y);
      const [ax, ay, bx, by] = walls[row];
      [x, y] = ax === x && ay === y ? [bx, by] : [ax, ay];
    }
    if (outline.length > 0) outlines.push(outline);
  });
  return outlines;
}
