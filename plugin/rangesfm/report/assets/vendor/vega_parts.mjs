// What the figures take from Vega and Vega-Lite; build.sh makes vega.min.js of it. No maps, forces or hierarchies.
import { transforms } from "vega-dataflow";
import * as encode from "vega-encode";
import * as data from "vega-transforms";
import * as layout from "vega-view-transforms";

Object.assign(transforms, data, layout, encode);

export { expressionInterpreter } from "vega-interpreter"; // the page's policy forbids expressions to be compiled
export { compile } from "vega-lite";
export { parse } from "vega-parser";
export { View } from "vega-view";
