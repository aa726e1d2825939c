// What the parts measure, pulled from the world: values of a stream at given instants of device time.
//
// A part asks for one value at a time; behind it whole runs are fetched, as far as the world may be asked (the end of the grant:
// what the robot does later may not be decided yet). A stream's values:
//   0 "adc"  four counts of 24 bits
//   1 "mag"  one time of flight in picoseconds, negative: no stop pulse came
const RUN = 256;
export const ADC = 0;
export const MAG = 1;
export const BYTES = [16, 8]; // of a value on the wire to the parent, little endian: 4 x i32, i64

/** Signals from a function `fetch(stream, index, tNs, periodNs, n)` → Buffer of n values. */
export class Signals {
  constructor(fetch) {
    this.fetch = fetch;
    this.horizonNs = 0; // the world may be asked up to here
    this.runs = [null, null];
  }

  /** Four counts at `tNs`, conversion `index` since the converter's start, of conversions `periodNs` apart. */
  counts(index, tNs, periodNs) {
    const { data, at } = this.#value(ADC, index, tNs, periodNs);
    return [0, 4, 8, 12].map((i) => data.readInt32LE(at + i));
  }

  /** Picoseconds from the interrogation edge at `tNs` to the stop edge; negative if none comes. */
  flightPs(index, tNs, periodNs) {
    const { data, at } = this.#value(MAG, index, tNs, periodNs);
    return Number(data.readBigInt64LE(at));
  }

  #value(stream, index, tNs, periodNs) {
    let run = this.runs[stream];
    const place = run ? index - run.index : -1;
    const fits = run && place >= 0 && place < run.n && run.periodNs === periodNs && run.tNs + place * periodNs === tNs;
    if (fits) return { data: run.data, at: place * BYTES[stream] };
    const ahead = Math.floor((this.horizonNs - tNs) / periodNs) + 1;
    const n = Math.max(1, Math.min(RUN, ahead));
    run = { index, tNs, periodNs, n, data: this.fetch(stream, index, tNs, periodNs, n) };
    this.runs[stream] = run;
    return { data: run.data, at: 0 };
  }
}
