// Edges on the trigger inputs, GP6 and GP7, beside those that come with grants: bursts, pulses and bounces for tests.
//
// Control message: {edges: [[line, level, tNs], …]}, times since power-on.
const LINES = [6, 7];

export function attach(pico) {
  return {
    sampling: () => false,
    control: ({ edges }) => {
      for (const [line, level, tNs] of edges) {
        if (!(line in LINES)) throw new Error(`there is no trigger input ${line}`);
        pico.clock.createAlarm(() => pico.setPin(LINES[line], level)).schedule(Math.max(0, tNs - pico.nowNs));
      }
    },
  };
}
