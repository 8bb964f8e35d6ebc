/** The crops that the log keeps of a thing: of an object by run, the best view first; of a keyframe where its boxes are. */

import { address } from "../api/client";
import type { Crop } from "../api/types";
import { label } from "../model/names";
import { useAnswer } from "../state/answers";
import * as store from "../state/store";
import { ThingLink } from "./AnswerParts";

interface PicturesAnswer {
  pictures: Crop[];
}

export function Pictures({ thing, at, state }: { thing: store.Thing; at: number; state: unknown }) {
  const has = thing.kind === "object" || thing.kind === "keyframe";
  const path = has ? address("/api/pictures", { what: `${thing.kind}:${thing.id}`, at, known_at: store.knownAt(at) }) : null;
  const pictures = useAnswer<PicturesAnswer>(path, state).value?.pictures ?? [];
  if (pictures.length === 0) return null;
  return thing.kind === "object" ? <ByRun pictures={pictures} /> : <Frame pictures={pictures} />;
}

function Jpeg({ crop, style }: { crop: Crop; style?: preact.CSSProperties }) {
  const name = `${label(crop.class_name, 40)} ${crop.confidence.toFixed(2)}`;
  return <img src={`data:image/jpeg;base64,${crop.jpeg}`} alt={name} title={name} style={style} />;
}

function ByRun({ pictures }: { pictures: Crop[] }) {
  const runs = [...new Set(pictures.map((crop) => crop.run_id))];
  return (
    <section class="crops" aria-label="Pictures">
      {runs.map((run) => (
        <div key={run}>
          <h3>
            <bdi>{label(run, 60)}</bdi>
          </h3>
          <ul>
            {pictures.filter((crop) => crop.run_id === run).map((crop) => (
              <li key={crop.det_id}>
                <Jpeg crop={crop} />
                <ThingLink thing={{ kind: "keyframe", id: `${crop.run_id}/${crop.keyframe_id}` }}>{String(crop.keyframe_id)}</ThingLink>
              </li>
            ))}
          </ul>
        </div>
      ))}
    </section>
  );
}

/** The crops of one picture at their boxes; the log keeps no more of it. */
function Frame({ pictures }: { pictures: Crop[] }) {
  const [width, height] = pictures[0].picture ?? [2, 3].map((side) => Math.max(1, ...pictures.map((crop) => crop.bbox[side])));
  const percent = (part: number, whole: number) => `${(100 * Math.min(Math.max(part / whole, 0), 1)).toFixed(2)}%`;
  return (
    <section class="crops frame" aria-label="Pictures" style={{ aspectRatio: `${width} / ${height}` }}>
      {pictures.map((crop) => {
        const [x0, y0, x1, y1] = crop.bbox;
        return <Jpeg key={crop.det_id} crop={crop} style={{ left: percent(x0, width), top: percent(y0, height), width: percent(x1 - Math.max(x0, 0), width), height: percent(y1 - Math.max(y0, 0), height) }} />;
      })}
    </section>
  );
}
