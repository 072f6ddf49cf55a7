/* Adds the integrals at a point of the slave side to those of the two nodes of the master edge that it faces. */
static void contact_face(double radius, int edge, double x, double weight, double *nodes, double *g)
{
    const double begin = radius * contact_x[edge], end = radius * contact_x[edge + 1];
    const double right = weight * (x - begin) / (end - begin), left = weight - right;
    nodes[0] += left;
    nodes[1] += right;
    *g -= radius * (left * contact_y[edge] + right * contact_y[edge + 1]);
}

/* The condition on macro-edges of two slave edges, for a master polygon that mu[0] scales; see mortar.py and hertz.py.
 * Without an approach of the flats this is mu[1]. */
static int contact(const double *mu, int *ends, int *columns, double *values, double *g)
{
    const double radius = mu[0], approach = contact_approach > 0.0 ? contact_approach : mu[1];
    int next = 0, edge = 0;
    if (!(radius * contact_x[contact_masters - 1] >= contact_slave[2 * contact_macros])) return 0;
    for (int i = 0; i < contact_macros; i++) {
        int start = 0;
        g[i] = contact_height[i];
        for (int k = 0; k < 3; k++) {
            columns[next] = 2 * i + k;
            values[next++] = contact_on_slave[3 * i + k];
        }
        for (int e = 2 * i; e < 2 * i + 2; e++) {
            double from = contact_slave[e];
            for (int k = e * contact_points; contact_points ? k < (e + 1) * contact_points : from < contact_slave[e + 1]; k++) {
                double x = contact_points ? contact_abscissae[k] : from, weight = contact_weights[contact_points ? k : e];
                while (edge < contact_masters - 2 && radius * contact_x[edge + 1] <= x) edge++;
                if (!contact_points) { /* the segment up to the next node of either side */
                    const double to = fmin(contact_slave[e + 1], radius * contact_x[edge + 1]);
                    x = 0.5 * (from + to);
                    weight *= to - from;
                    from = to;
                }
                if (next == ends[i] + 3) start = next - edge;
                for (; next < start + edge + 2; next++) { /* nodes of the master that the row has not met */
                    columns[next] = 2 * contact_macros + 1 + next - start;
                    values[next] = 0.0;
                }
                contact_face(radius, edge, x, weight, values + start + edge, g + i);
            }
        }
        ends[i + 1] = next;
        for (int k = ends[i]; k < next; k++) g[i] -= approach * values[k] * contact_lift[columns[k]];
    }
    return 1;
}
