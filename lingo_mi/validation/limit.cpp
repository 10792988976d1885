// A CPU speed limit to compare with: the exact Gaussian footprint (forward) and its gradient sums (backward),
// by hand in AVX2, two threads. Nothing of the real program is here but the arithmetic per (Gaussian, pixel) pair:
// no projection, no culling, fixed square boxes. Build and run:
//     g++ -O3 -march=native -pthread lingo_mi/validation/limit.cpp -o limit && ./limit 50000 7.6
// Arguments: Gaussians, half-width of the 3-sigma box in pixels. Prints ns per pair, best of five.
#include <immintrin.h>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <random>
#include <thread>
#include <vector>

using V = __m256;
static inline V set1(float x) { return _mm256_set1_ps(x); }
static inline V fma(V a, V b, V c) { return _mm256_fmadd_ps(a, b, c); }
static inline V mul(V a, V b) { return _mm256_mul_ps(a, b); }

static inline V vexp(V x) {  // degree-5 polynomial after range reduction, about 2 ulp
    x = _mm256_max_ps(x, set1(-87.f));
    V n = _mm256_round_ps(mul(x, set1(1.44269504f)), 0);
    V r = _mm256_fnmadd_ps(n, set1(-2.12194440e-4f), _mm256_fnmadd_ps(n, set1(0.693359375f), x));
    V y = set1(1.9875691500e-4f);
    for (float c : {1.3981999507e-3f, 8.3334519073e-3f, 4.1665795894e-2f, 1.6666665459e-1f, 0.5f}) y = fma(y, r, set1(c));
    y = fma(y, mul(r, r), _mm256_add_ps(r, set1(1.f)));
    return mul(y, _mm256_castsi256_ps(_mm256_slli_epi32(_mm256_add_epi32(_mm256_cvtps_epi32(n), _mm256_set1_epi32(127)), 23)));
}

int main(int argc, char **argv) {
    const int M = argc > 1 ? atoi(argv[1]) : 50000, W = 512;
    const float half = argc > 2 ? atof(argv[2]) : 7.6f;
    std::mt19937 rng(0);
    std::uniform_real_distribution<float> U(100, 412);
    std::vector<float> u(M), v(M), grad(size_t(M) * 12), image[2], upstream(W * W + 64, 0.5f);
    for (int i = 0; i < M; i++) u[i] = U(rng), v[i] = U(rng);
    const V lane = _mm256_setr_ps(0, 1, 2, 3, 4, 5, 6, 7);
    const float s = half / 3, A = 1 / (s * s), B = .2f * A, C = A;

    auto pass = [&](int th, bool backward) {
        long pairs = 0;
        if (!backward) image[th].assign(W * W + 64, 0.f);
        for (int i = th; i < M; i += 2) {
            int x0 = std::ceil(u[i] - half - .5f), x1 = std::floor(u[i] + half - .5f);
            int y0 = std::ceil(v[i] - half - .5f), y1 = std::floor(v[i] + half - .5f);
            V g[12];
            for (V &x : g) x = _mm256_setzero_ps();
            for (int y = y0; y <= y1; y++) {
                V dv = set1(y + .5f - v[i]);
                for (int x = x0; x <= x1; x += 8) {
                    V du = _mm256_add_ps(set1(x + .5f - u[i]), lane);
                    V num = fma(du, fma(set1(A), du, mul(set1(2 * B), dv)), mul(set1(C), mul(dv, dv)));
                    V den = fma(du, fma(set1(1e-6f), du, set1(1e-5f)), fma(dv, set1(1e-5f), set1(1.f)));
                    V r = _mm256_div_ps(set1(1.f), den);
                    V e = mul(_mm256_sqrt_ps(r), vexp(mul(set1(-.5f), mul(num, r))));
                    int left = x1 - x + 1;
                    V mask = _mm256_castsi256_ps(_mm256_cmpgt_epi32(_mm256_set1_epi32(left), _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7)));
                    e = _mm256_and_ps(e, mask);
                    pairs += left < 8 ? left : 8;
                    if (!backward) {
                        float *p = &image[th][y * W + x];
                        _mm256_storeu_ps(p, _mm256_add_ps(_mm256_loadu_ps(p), e));
                        continue;
                    }
                    V ge = mul(_mm256_loadu_ps(&upstream[y * W + x]), e);
                    V gn = mul(set1(-.5f), mul(r, ge)), gd = mul(ge, mul(r, fma(mul(set1(.5f), num), r, set1(-.5f))));
                    V uu = mul(du, du), uv = mul(du, dv), vv = mul(dv, dv);
                    g[0] = _mm256_add_ps(g[0], ge);
                    g[1] = fma(gn, uu, g[1]), g[2] = fma(gn, uv, g[2]), g[3] = fma(gn, vv, g[3]);
                    g[4] = _mm256_add_ps(g[4], gd), g[5] = fma(gd, du, g[5]), g[6] = fma(gd, dv, g[6]);
                    g[7] = fma(gd, uu, g[7]), g[8] = fma(gd, uv, g[8]), g[9] = fma(gd, vv, g[9]);
                    g[10] = fma(gn, fma(set1(A), du, mul(set1(B), dv)), g[10]);
                    g[11] = fma(gn, fma(set1(B), du, mul(set1(C), dv)), g[11]);
                }
            }
            if (backward)
                for (int j = 0; j < 12; j++) {
                    float t[8], sum = 0;
                    _mm256_storeu_ps(t, g[j]);
                    for (float x : t) sum += x;
                    grad[size_t(i) * 12 + j] = sum;
                }
        }
        return pairs;
    };
    for (bool backward : {false, true}) {
        double best = 1e9;
        long pairs = 0;
        for (int rep = 0; rep < 5; rep++) {
            auto t0 = std::chrono::steady_clock::now();
            long n[2];
            std::thread a([&] { n[0] = pass(0, backward); }), b([&] { n[1] = pass(1, backward); });
            a.join(), b.join();
            best = std::min(best, std::chrono::duration<double>(std::chrono::steady_clock::now() - t0).count());
            pairs = n[0] + n[1];
        }
        printf("%s: %ld pairs, %.2f ms, %.3f ns/pair\n", backward ? "backward" : "forward ", pairs, best * 1e3, best * 1e9 / pairs);
    }
    double check = 0;
    for (auto &im : image) for (float f : im) check += f;
    for (float f : grad) check += f;
    fprintf(stderr, "checksum %g\n", check);
}
