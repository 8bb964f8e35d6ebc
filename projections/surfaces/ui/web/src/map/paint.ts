/** Draws a map, from the ground up. The same calls make the picture on the screen and the SVG. */

import { drawGrid, drawRegions, drawWalls } from "./ground";
import { drawKeyframes, drawRobot } from "./keyframes";
import { drawLabels } from "./labels";
import { arrow, drawBridge, drawDifference, drawLikely, drawLost, drawWay } from "./overlays";
import type { Scene } from "./scene";
import type { Surface } from "./surface";
import { drawEdges, drawObjects } from "./things";

export function paint(on: Surface, scene: Scene) {
  drawGrid(on, scene);
  if (scene.layers.regions) drawRegions(on, scene);
  if (scene.layers.walls && scene.walls.length > 0) drawWalls(on, scene);
  drawLikely(on, scene);
  if (scene.layers.edges) drawEdges(on, scene);
  if (scene.layers.path || scene.layers.keyframes) drawKeyframes(on, scene);
  if (scene.layers.objects) drawObjects(on, scene);
  drawDifference(on, scene);
  drawWay(on, scene);
  drawRobot(on, scene);
  if (scene.layers.labels) drawLabels(on, scene);
  if (scene.bridge !== null) drawBridge(on, scene, scene.bridge);
  drawLost(on, scene);
  if (scene.drag !== null) arrow(on, scene, scene.drag.x0, scene.drag.y0, scene.drag.x1, scene.drag.y1);
}
