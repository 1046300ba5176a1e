"""The browser demo as a hosted Gradio space: the space runs this file, with the extra ``demo`` installed."""

from kornia_learnnorm.browser_demo import launch, make_app

app = make_app()

if __name__ == "__main__":
    launch(app)
