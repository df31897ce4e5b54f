// Solve one problem with a package, without Python:
//
//   pnpnet export pnpnet-n9.pt2 --solver pnpnet-n9 --batch 1
//   ./pnpnet_solve pnpnet-n9.pt2 matches.csv 3400 3400 1550 1030
//
// The file has the header X,Y,Z,u,v and one correspondence per line; the numbers are fx, fy, cx and cy in pixels.
#include <torch/csrc/inductor/aoti_package/model_package_loader.h>
#include <torch/torch.h>

#include <cstdlib>
#include <fstream>
#include <iostream>
#include <stdexcept>
#include <string>
#include <vector>

// Rows of X, Y, Z, u, v, shape (N, 5), float32.
torch::Tensor read_pairs(const std::string& path) {
  std::ifstream file(path);
  std::string line;
  const auto next = [&] {
    const bool found = static_cast<bool>(std::getline(file, line));
    if (found && !line.empty() && line.back() == '\r') line.pop_back();
    return found;
  };
  if (!next()) throw std::runtime_error(path + ": cannot be read");
  if (line != "X,Y,Z,u,v") throw std::runtime_error(path + ": expected the header X,Y,Z,u,v");
  std::vector<float> numbers;
  while (next()) {
    if (line.empty()) continue;
    const char* rest = line.c_str();
    for (int column = 0; column < 5; ++column) {
      char* end = nullptr;
      numbers.push_back(std::strtof(rest, &end));
      if (end == rest) throw std::runtime_error(path + ": expected five numbers in '" + line + "'");
      rest = *end == ',' ? end + 1 : end;
    }
  }
  return torch::tensor(numbers).view({-1, 5});
}

int main(int argc, char** argv) try {
  if (argc != 7) throw std::runtime_error("usage: pnpnet_solve PACKAGE CSV FX FY CX CY");
  const c10::InferenceMode guard;
  const torch::Tensor pairs = read_pairs(argv[2]);
  const float fx = std::stof(argv[3]), fy = std::stof(argv[4]), cx = std::stof(argv[5]), cy = std::stof(argv[6]);

  torch::inductor::AOTIModelPackageLoader solver(argv[1]);
  // A package does not check shapes, dtypes or memory layouts: pass contiguous float32 of the exported sizes.
  const auto sizes = solver.get_metadata();
  const std::string n = sizes.at("pnpnet_n"), batch = sizes.at("pnpnet_batch");
  if (n != "any" && n != std::to_string(pairs.size(0))) throw std::runtime_error("the package is for n = " + n);
  if (n == "any" && pairs.size(0) < 4) throw std::runtime_error("at least 4 pairs are needed");
  if (batch != "any" && batch != "1") throw std::runtime_error("the package is for batches of " + batch);

  const torch::Tensor world_points = pairs.narrow(1, 0, 3).unsqueeze(0).contiguous();  // (1, N, 3)
  const torch::Tensor img_points = pairs.narrow(1, 3, 2).unsqueeze(0).contiguous();    // (1, N, 2), pixels
  const torch::Tensor intrinsics = torch::tensor({fx, 0.f, cx, 0.f, fy, cy, 0.f, 0.f, 1.f}).view({1, 3, 3});
  const torch::Tensor weights = torch::ones({1, pairs.size(0)});  // (1, N), 0 for padding

  // rotation (1, 3, 3), translation (1, 3), pair_weights (1, N), cost (1,), ok (1,); clone what must outlive the next
  // call of this thread, which may write over these tensors.
  const std::vector<torch::Tensor> result = solver.run({world_points, img_points, intrinsics, weights});
  const torch::Tensor rotation = result[0].contiguous(), translation = result[1].contiguous();
  std::cout.precision(9);
  for (int i = 0; i < 9; ++i) std::cout << rotation.data_ptr<float>()[i] << (i < 8 ? ' ' : '\n');
  for (int i = 0; i < 3; ++i) std::cout << translation.data_ptr<float>()[i] << (i < 2 ? ' ' : '\n');
  std::cout << (result[4].item<bool>() ? "ok" : "not ok") << std::endl;
  return 0;
} catch (const c10::Error& error) {
  std::cerr << "pnpnet_solve: " << error.what_without_backtrace() << '\n';
  return 2;
} catch (const std::exception& error) {
  std::cerr << "pnpnet_solve: " << error.what() << '\n';
  return 2;
}
