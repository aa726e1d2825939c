/* A calibrated robot arm in C99: the pose of its end at joint readings, and the readings at which its end has a pose.

   Units: m, rad, kg. A pose has three rows of [R | p] in the base frame. Declare in your program:

     void truearm_forward(const double *q, double pose[3][4]);
     double truearm_correct(double pose[3][4], double *q);

   truearm_correct changes readings q to those near them at which the arm has the pose. It returns the remaining error:
   the larger of the distance [m] and of 2*sin(turn/2) [rad]. Use q only if this error is below your limit. Each
   reading stays within LARGEST_CHANGE [rad or m] of the q that you pass and within the joint limits; the error of a
   pose that has no such readings, or of an R that is no rotation, is not small. If the pose or q is not finite, or q
   lies farther than that outside the joint limits, q is unchanged and the error is HUGE_VAL.

   No memory is allocated and nothing is static but constants. Link with -lm. */

#include <math.h>

/* tables */

/* end tables */

#define LARGEST_CHANGE 0.5
#define LARGEST_STEP 0.1
#define STEPS 60
#define STEP_END 1e-13
#define DAMPING 1e-12

typedef double frame[3][4];

void truearm_forward(const double *q, double pose[3][4]);
double truearm_correct(double pose[3][4], double *q);

static void cross(const double *a, const double *b, double *out)
{
    int k;
    for (k = 0; k < 3; k++)
        out[k] = a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3];
}

/* The frame of each joint after its motion along or about z, then the end's. */
static void chain(const double links[JOINTS + 1][3][4], const double *angles, frame *out)
{
    int i, r, c;
    double here[3][4];
    for (r = 0; r < 3; r++)
        for (c = 0; c < 4; c++)
            here[r][c] = links[0][r][c];
    for (i = 0; i < JOINTS; i++) {
        double co = cos(angles[i]), si = sin(angles[i]);
        for (r = 0; r < 3; r++) {
            double x = here[r][0], y = here[r][1];
            if (SLIDES[i]) {
                here[r][3] += angles[i] * here[r][2];
            } else {
                here[r][0] = co * x + si * y;
                here[r][1] = co * y - si * x;
            }
            for (c = 0; c < 4; c++)
                out[i][r][c] = here[r][c];
        }
        for (r = 0; r < 3; r++)
            for (c = 0; c < 4; c++) {
                const double *row = out[i][r];
                here[r][c] = row[0] * links[i + 1][0][c] + row[1] * links[i + 1][1][c] + row[2] * links[i + 1][2][c];
                if (c == 3)
                    here[r][c] += row[3];
            }
    }
    for (r = 0; r < 3; r++)
        for (c = 0; c < 4; c++)
            out[JOINTS][r][c] = here[r][c];
}

/* A cubic B-spline of uniform knots, whose readings a turn apart are equal. */
static double spline(double reading, int curve)
{
    const double turn = 6.283185307179586, first = CURVE_FIRST[curve], spacing = CURVE_SPACING[curve];
    const int count = CURVE_COUNT[curve];
    const double middle = first + 0.5 * (count - 1) * spacing;
    const double place = (reading - turn * floor((reading - middle) / turn + 0.5) - first) / spacing;
    const int cell = (int)floor(place);
    const double u = place - cell, v = 1.0 - u;
    const double weights[4] = {v * v * v, 4 - 6 * u * u + 3 * u * u * u, 1 + 3 * (u + u * u - u * u * u), u * u * u};
    double total = 0.0;
    int k;
    for (k = 0; k < 4; k++) {
        int index = cell - 1 + k;
        if (CURVE_PERIODIC[curve])
            index = (index % count + count) % count;
        if (index >= 0 && index < count)
            total += COEFFICIENTS[CURVE_START[curve] + index] * weights[k] / 6.0;
    }
    return total;
}

/* The joints' true angles or positions: offset + gain*q + error curve(q) + sag. */
static void true_angles(const double *q, double *angles)
{
    int i, k, r;
    for (i = 0; i < JOINTS; i++)
        angles[i] = OFFSETS[i] + GAINS[i] * q[i];
    for (k = 0; k < CURVES; k++)
        angles[CURVE_JOINT[k]] += spline(q[CURVE_JOINT[k]], k);
    if (SAGS > 0) {
        double drawn[JOINTS];
        frame frames[JOINTS + 1];
        for (i = 0; i < JOINTS; i++)
            drawn[i] = NOMINAL_OFFSETS[i] + NOMINAL_GAINS[i] * q[i];
        chain(NOMINAL_LINKS, drawn, frames);
        for (k = 0; k < SAGS; k++) {
            const int joint = SAG_JOINT[k], is_payload = SAG_POINT[k] > JOINTS;
            frame *at = &frames[is_payload ? JOINTS : SAG_POINT[k]];
            double axis[3], pull[3], torque = 0.0;
            for (r = 0; r < 3; r++)
                axis[r] = frames[joint][r][2];
            cross(SAG_GRAVITY[k], axis, pull);
            for (r = 0; r < 3; r++) {
                double point = (*at)[r][3];
                for (i = 0; i < 3 && is_payload; i++)
                    point += (*at)[r][i] * PAYLOAD_CENTRE[i];
                torque += pull[r] * (point - frames[joint][r][3]);
            }
            angles[joint] += SAG_COMPLIANCE[k] * (is_payload ? PAYLOAD_MASS : 1.0) * torque;
        }
    }
}

void truearm_forward(const double *q, double pose[3][4])
{
    double angles[JOINTS];
    frame frames[JOINTS + 1];
    int r, c;
    true_angles(q, angles);
    chain(LINKS, angles, frames);
    for (r = 0; r < 3; r++)
        for (c = 0; c < 4; c++)
            pose[r][c] = frames[JOINTS][r][c];
}

/* Solve six linear equations by elimination with pivots; the solution is left in rows[..][6]. */
static void solve(double rows[6][7])
{
    int i, j, k;
    for (i = 0; i < 6; i++) {
        int pivot = i;
        for (k = i + 1; k < 6; k++)
            if (fabs(rows[k][i]) > fabs(rows[pivot][i]))
                pivot = k;
        for (j = 0; j < 7; j++) {
            double kept = rows[i][j];
            rows[i][j] = rows[pivot][j];
            rows[pivot][j] = kept;
        }
        for (k = i + 1; k < 6; k++) {
            double factor = rows[k][i] / rows[i][i];
            for (j = i; j < 7; j++)
                rows[k][j] -= factor * rows[i][j];
        }
    }
    for (i = 5; i >= 0; i--) {
        for (k = i + 1; k < 6; k++)
            rows[i][6] -= rows[i][k] * rows[k][6];
        rows[i][6] /= rows[i][i];
    }
}

double truearm_correct(double pose[3][4], double *q)
{
    double error, lower[JOINTS], upper[JOINTS];
    int i, k, r, s, round;
    for (i = 0; i < JOINTS; i++) {
        lower[i] = fmax(LOWER[i], q[i] - LARGEST_CHANGE);
        upper[i] = fmin(UPPER[i], q[i] + LARGEST_CHANGE);
        if (!isfinite(q[i]) || lower[i] > upper[i])
            return HUGE_VAL;
    }
    for (k = 0; k < 12; k++)
        if (!isfinite(pose[k / 4][k % 4]))
            return HUGE_VAL;
    for (round = 0;; round++) {
        double angles[JOINTS], columns[JOINTS][6], rows[6][7], steps[JOINTS];
        double distance = 0.0, turn = 0.0, largest = LARGEST_STEP, moved = 0.0;
        frame frames[JOINTS + 1];
        const frame *here = (const frame *)&frames[JOINTS];
        true_angles(q, angles);
        chain(LINKS, angles, frames);
        for (k = 0; k < 3; k++) {
            const int a = (k + 1) % 3, b = (k + 2) % 3;
            rows[k][6] = pose[k][3] - (*here)[k][3];
            rows[k + 3][6] = 0.0;
            for (i = 0; i < 3; i++) {
                const double change = pose[k][i] - (*here)[k][i];
                rows[k + 3][6] += 0.5 * (pose[b][i] * (*here)[a][i] - pose[a][i] * (*here)[b][i]);
                turn += 0.5 * change * change;
            }
            distance += rows[k][6] * rows[k][6];
        }
        error = sqrt(fmax(distance, turn));
        if (round == STEPS)
            return error;
        for (i = 0; i < JOINTS; i++) {
            double axis[3], arm[3];
            for (k = 0; k < 3; k++) {
                axis[k] = frames[i][k][2] * GAINS[i];
                arm[k] = (*here)[k][3] - frames[i][k][3];
            }
            cross(axis, arm, columns[i]);
            for (k = 0; k < 3; k++) {
                columns[i][k] = SLIDES[i] ? axis[k] : columns[i][k];
                columns[i][k + 3] = SLIDES[i] ? 0.0 : axis[k];
            }
        }
        /* Damped by the squared error: short steps where the arm is singular, Newton's near the pose (Sugihara 2011). */
        for (r = 0; r < 6; r++)
            for (s = 0; s < 6; s++) {
                rows[r][s] = r == s ? DAMPING + error * error : 0.0;
                for (i = 0; i < JOINTS; i++)
                    rows[r][s] += columns[i][r] * columns[i][s];
            }
        solve(rows);
        for (i = 0; i < JOINTS; i++) {
            steps[i] = 0.0;
            for (k = 0; k < 6; k++)
                steps[i] += columns[i][k] * rows[k][6];
            if (!isfinite(steps[i]))
                return error;
            largest = fmax(largest, fabs(steps[i]));
        }
        for (i = 0; i < JOINTS; i++) {
            const double reading = fmin(fmax(q[i] + LARGEST_STEP / largest * steps[i], lower[i]), upper[i]);
            moved = fmax(moved, fabs(reading - q[i]));
            q[i] = reading;
        }
        if (moved < STEP_END)
            return error;
    }
}
