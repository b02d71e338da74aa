import { MeshStandardMaterial } from 'three';

/** The colours of a surface, of a file by `mitsuba-diffraction export SURFACE -o NAME.bin`. */
export class DiffractionData {
  /** Parse a file. Throws an Error if it is another file, of another version, or cut short. */
  constructor(buffer: ArrayBuffer);
  readonly kind: 'table' | 'orders';
  readonly source: string;
  readonly material: string;
  /** ΔE00 beside the integral over the wavelength, and the relative error of the flux. */
  readonly error: { mean: number; percentile_95: number; maximum: number; flux: number };
  /** Degrees from the tangent along u to the pattern's x axis, or radial or tangential. */
  readonly orientation: number | 'radial' | 'tangential';
  /** Of the medium below, "#rrggbb". */
  readonly base: string;
  /** Index of the clear layer above; 1 of none. */
  readonly coat: number;
  /** Values of the uniforms of `shadingOf`. */
  readonly uniforms: Record<string, unknown>;
}

/** Load a file of colours; null, and one message in the console, if it cannot be read. */
export function loadDiffraction(url: string): Promise<DiffractionData | null>;

export interface DiffractionMaterialParameters {
  /** Degrees from the tangent along u, or from the radius if `radial`, to the pattern's x axis; or radial or tangential. */
  orientation?: number | 'radial' | 'tangential';
  /** Whether the pattern turns about the middle of the texture coordinates, as on discs. */
  radial?: boolean;
  /** Directions of the environment map in which overlapping orders are looked up, at most 256; default 64. */
  skyPoints?: number;
  /** Factor of the heights of separate orders, 0 to 1; others are refused in the console and shown with 1, the default. */
  heightScale?: number;
  /** Parameters of MeshStandardMaterial: color (the base), envMap, side, emissive, opacity, … */
  [parameter: string]: unknown;
}

/** A mesh with a diffracting surface and texture coordinates; of null it is grey. */
export class DiffractionMaterial extends MeshStandardMaterial {
  constructor(data: DiffractionData | null, parameters?: DiffractionMaterialParameters);
}

/** GLSL of f for the data of a surface: ofLamp(c, a, b, isDisc, wo) is f cos θ_i as XYZ under D65, see shading.js. */
export function shadingOf(data: DiffractionData): string;
